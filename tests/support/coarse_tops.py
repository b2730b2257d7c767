"""Archives opened for tests of coarse bounds, with chosen voxels resident and chosen slots filled."""

import math
from pathlib import Path
from typing import NamedTuple

import archive_cases
import naive
import numpy as np
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.schemas.archive.radius_model import class_radii
from solidcloud.server.avatars.avatar_model import AvatarModel
from solidcloud.server.kernels.collide.coarse_clearance import MAX_SLOT_NODES
from solidcloud.server.kernels.core.scene_arrays import ROW_WORDS, Arena, SceneArrays, block_words
from solidcloud.server.kernels.core.voxels_in_reach import VALID, SceneIndex, VoxelsInReach, find_reach
from solidcloud.server.residency.arena import ArenaBuffer
from solidcloud.server.residency.coarse_bounds import CoarseBounds, drop_clear_pairs
from solidcloud.server.residency.voxel_store import VoxelStore

# Large enough for the coarse bounds of all voxels of any scene here.
ROOM = 1 << 25


class Made(NamedTuple):
    """An open archive. loaded: (v, 3) int64, offsets of all voxels in the arena.

    arrays, broad: arguments of kernels; no voxel is resident.
    largest: radius of the largest sphere, exact units.
    """

    store: VoxelStore
    arena: Arena
    loaded: NDArray[np.int64]
    arrays: SceneArrays
    broad: SceneIndex
    largest: int
    coarse: CoarseBounds

    @property
    def voxels(self) -> int:
        """Return the number of voxels."""
        return len(self.loaded)

    def resident(self, *rows: int) -> "Made":
        """Return the same archive with only these voxels resident."""
        where = np.full_like(self.loaded, -1)
        where[list(rows)] = self.loaded[list(rows)]
        return self._replace(arrays=self.arrays._replace(where=where))

    def remember(self, row: int) -> None:
        """Store the coarse bounds of a voxel."""
        self.coarse.store_from_arena(row, self.arena, self.loaded[row])

    def fill(self, *but: int) -> None:
        """Store the coarse bounds of all voxels except these."""
        for row in set(range(self.voxels)) - set(but):
            self.coarse.store_from_archive(self.store, row)

    def top(self, row: int, coarse: CoarseBounds | None = None) -> NDArray[np.int32]:
        """Return the rows (n, ROW_WORDS) in a voxel's slot."""
        arrays = (coarse or self.coarse).arrays
        number = arrays.slot[row]
        assert number >= 0
        return arrays.ints.reshape(-1, MAX_SLOT_NODES, ROW_WORDS)[number, : arrays.count[number]].copy()

    def reach(self, avatar: AvatarModel, poses: NDArray[np.float64], margin: int = 0) -> VoxelsInReach:
        """Return the reach of the avatar. margin: exact units."""
        k = len(poses)
        reach = VoxelsInReach(
            np.empty(k, np.int64),
            np.zeros(k + 1, np.int64),
            np.empty(k * max(1, self.voxels), np.int64),
            np.empty((k, 2, 3)),
            np.zeros(k, bool),
        )
        other = self.largest + margin
        fault, *_ = find_reach(poses, avatar.arrays, avatar.radius, other, self.arrays, self.broad, reach)
        assert fault == VALID
        return reach

    def settled(
        self, avatar: AvatarModel, poses: NDArray[np.float64], margin: int = 0
    ) -> tuple[list[list[int]], list[list[int]]]:
        """Return the voxel rows in reach of each pose, and those that coarse bounds prove clear."""
        reach = self.reach(avatar, poses, margin)
        found, count = drop_clear_pairs(self.arrays, self.coarse.arrays, avatar.arrays, poses, reach)
        before, left = rows_of(reach), rows_of(found)
        gone = [[row for row in b if row not in a] for b, a in zip(before, left, strict=True)]
        assert [[r for r in b if r in a] for b, a in zip(before, left, strict=True)] == left
        assert count == sum(map(len, gone))
        return before, gone


def rows_of(reach: VoxelsInReach) -> list[list[int]]:
    """Return the voxel rows of each pose."""
    ends = zip(reach.starts[:-1], reach.starts[1:], strict=True)
    return [reach.rows[begin:end].tolist() for begin, end in ends]


def open_made(
    folder: Path, model: str | None = None, budget_bytes: int = ROOM, *, boxes: bool = True
) -> Made:
    """Open an archive and load all its voxels, with the spheres of a radius model.

    boxes: whether nodes have boxes where these are tighter. They are computed from points, so slots
    filled without points have slabs only, and differ from those of loaded voxels.
    """
    store = VoxelStore(folder)
    store._with_boxes = store._with_boxes and boxes
    archive, header = store.archive, store.archive.header
    sizes = [ArenaBuffer.rounded(int(size)) for size in store.sizes]
    buffer = ArenaBuffer(sum(sizes))
    loaded = np.full((len(sizes), 3), -1, np.int64)
    for row, size in enumerate(sizes):
        offset = buffer.allocate(size)
        assert offset is not None
        loaded[row] = store.load(row, buffer.arena, offset)
    radii = class_radii(model, header.radius, header.models)
    lattice, base = header.lattice, archive.coordinates * header.lattice.voxel_steps
    arrays = SceneArrays(
        *buffer.arena,
        np.full_like(loaded, -1),
        archive.coordinates,
        np.array(lattice.origin),
        lattice.step,
        lattice.units_per_step,
        lattice.voxel_steps,
        block_words(header.radius_class),
        radii.max() - radii,
        np.zeros(1, np.int64),
    )
    broad = SceneIndex(
        archive.voxels["key"].astype(np.uint64),
        base + archive.voxels["low"],
        base + archive.voxels["high"],
        header.low,
        header.high,
    )
    coarse = CoarseBounds(len(sizes), budget_bytes)
    return Made(store, buffer.arena, loaded, arrays, broad, int(radii.max()), coarse)


def build_scattered(folder: Path) -> Path:
    """Build an archive of eight voxels with hierarchies of a few levels.

    Some have fewer leaf nodes than a slot holds.
    """
    points = synthetic_scans.make_scan("noise", 3, 2500) ** 2 / synthetic_scans.SIZE
    return archive_cases.build(folder, points, voxel=1.0, leaf=2, degree=3, cell_points=50).archive


def least_margin(
    made: Made,
    row: int,
    points: NDArray[np.int64],
    radii: NDArray[np.int64],
    avatar: AvatarModel,
    pose: NDArray[np.float64],
) -> int:
    """Return the least margin, exact units, at which an avatar touches a voxel, by definition.

    The result may be negative.
    points: (p, 3) of the voxel [voxel steps].  radii: (p,) of their spheres, exact units.
    """
    header = made.store.archive.header
    base = made.store.archive.coordinates[row] * header.lattice.voxel_steps
    b = naive.scan_units(points + base, header.lattice.step)
    a = naive.placed_units(avatar.points, pose, header.lattice.origin)
    own = naive.reach_units(avatar.radius, 0.0, 0.0)
    found = []
    for radius in np.unique(radii):
        square = naive.least_square(a, b[radii == radius])
        root = math.isqrt(square)
        found.append(root + (root * root < square) - int(radius) - own)
    return min(found)
