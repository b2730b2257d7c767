"""Scene: an archive opened in this process, and the questions asked of it. The same methods as `Client`."""

import threading
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..schemas.answers import CollideAnswers
from ..schemas.archive import FORMAT_VERSION
from ..schemas.errors import BadRequestError, UnknownAvatarError
from ..schemas.messages import WIRE_VERSION, AvatarInfo, SceneInfo, SourceInfo
from .avatar import AvatarModel, make_avatar
from .collide import collide
from .request import make_scene_data
from .residency import Residency
from .store import Store

DEFAULT_BUDGET = 512 << 20


class Scene:
    """A served archive. Thread-safe; a context manager.

    name: what clients call it; the archive's folder name unless given.
    """

    def __init__(self, store: Store, name: str, budget_bytes: int) -> None:
        """Serve the voxels of `store`; use `Scene.open`."""
        self.name = name
        self._store = store
        self._data = make_scene_data(store.archive, Residency(store, budget_bytes))
        self._avatars: dict[tuple[str, str], AvatarModel] = {}
        self._lock = threading.Lock()

    @classmethod
    def open(
        cls, folder: str | Path, name: str | None = None, *, budget_bytes: int = DEFAULT_BUDGET
    ) -> "Scene":
        """Open the archive in `folder`, keeping at most budget_bytes of decoded voxels in memory.

        Raises FormatError or CorruptError when it is no whole archive, BadRequestError for too small a budget.
        """
        store = Store(folder)
        try:
            return cls(store, name or Path(folder).resolve().name, budget_bytes)
        except BaseException:
            store.close()
            raise

    def __enter__(self) -> "Scene":
        """The scene itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the archive."""
        self.close()

    def close(self) -> None:
        """Close the archive's files."""
        self._store.close()

    @property
    def residency(self) -> Residency:
        """The resident voxels, for counters and checks."""
        return self._data.residency

    def warm(self) -> None:
        """Ask one of everything, a load included, so that nobody waits for compilers after."""
        archive = self._store.archive
        row = int(np.argmin(self._store.sizes))
        corner = archive.coordinates[row] * archive.header.lattice.voxel_steps + archive.voxels["low"][row]
        pose = np.eye(4)[None]
        pose[0, :3, 3] = archive.header.lattice.to_world(corner)
        collide(self._data, make_avatar([[0.0, 0, 0], [0.1, 0, 0]]), pose)

    def info(self) -> SceneInfo:
        """What is served: counts, bounds, lattice, radius, sources."""
        return describe(self._store, self.name)

    def add_avatar(
        self, name: str, points: ArrayLike, radius: float | None = None, *, client: str = ""
    ) -> AvatarInfo:
        """Add an avatar of points (n, 3) float64, avatar frame [m].

        radius: of each point's sphere [m]; None: half the mean closest-point distance of the points.
        client: whose it is; avatars of different clients do not meet. The same name again with the same points and
        radius changes nothing; with others it is a BadRequestError.
        """
        model = make_avatar(points, radius)
        with self._lock:
            known = self._avatars.setdefault((client, name), model)
        if known is not model and not (
            known.radius == model.radius and np.array_equal(known.points, model.points)
        ):
            raise BadRequestError(
                f"avatar {name!r} exists with other points or another radius: use another name"
            )
        return AvatarInfo(name, len(model.points), model.radius, model.bounding_radius)

    def collide(
        self, name: str, poses: ArrayLike, margin: float = 0.0, *, client: str = ""
    ) -> CollideAnswers:
        """Whether avatar `name` touches the scene under each of the poses (k, 4, 4); see server/collide.py."""
        with self._lock:
            avatar = self._avatars.get((client, name))
        if avatar is None:
            raise UnknownAvatarError(f"avatar {name!r} is not known: add it with add_avatar first")
        return collide(self._data, avatar, poses, margin)

    def drop_client(self, client: str) -> None:
        """Forget the avatars of a client that is gone."""
        with self._lock:
            for key in [key for key in self._avatars if key[0] == client]:
                del self._avatars[key]


def describe(store: Store, name: str) -> SceneInfo:
    """What the archive of `store` holds: counts, bounds, lattice, radius, sources. Reads no voxel."""
    header = store.archive.header
    lattice = header.lattice
    return SceneInfo(
        scene=name,
        format_version=FORMAT_VERSION,
        wire_version=WIRE_VERSION,
        points=header.points,
        voxels=len(store.sizes),
        bounds=lattice.to_world(np.stack([header.low, header.high])).tolist(),
        origin=list(lattice.origin),
        lattice_step=lattice.step,
        lattice_source=header.lattice_source,
        voxel_size=lattice.voxel_size,
        radius=header.radius,
        radius_model=header.radius_model,
        radius_error=header.radius_error,
        radius_sample=header.radius_sample,
        moved_max=header.moved_max,
        degree=header.degree,
        leaf=header.leaf,
        sources=[
            SourceInfo(s.path, s.index, s.sha256, s.count, s.format, s.pose.tolist(), s.skipped)
            for s in header.sources
            if not s.fault
        ],
        skipped=[s.fault for s in header.sources if s.fault],
        record_bytes=int(store.archive.voxels["frame_bytes"].sum(dtype=np.int64)),
        resident_bytes=int(store.sizes.sum()),
        unknown=[lattice.to_world(box).tolist() for box in header.unknown],
        unknown_everywhere=header.unknown_everywhere,
    )
