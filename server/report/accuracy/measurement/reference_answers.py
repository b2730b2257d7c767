"""Reference answers, with which the settings are compared: the server's exact ones, checked by brute force."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .....builder.voxel.record_points import voxel_points
from .....schemas.archive.archive import Archive
from .....schemas.archive.units import UNITS_PER_METRE
from .....schemas.errors import BadDataError, InternalError
from .....schemas.wire.answers import Verdict
from ....avatars.avatar_model import make_avatar
from ....scene import Scene
from .measured_scene import AVATAR, REACH, SEED, MeasuredScene
from .measurement_plan import MeasurementPlan

Floats = NDArray[np.float64]
Units = NDArray[np.int64]
Bools = NDArray[np.bool_]

# Absolute signed distance of near-tangent poses, from one exact unit to a micrometre [m].
MIN_OFFSET, MAX_OFFSET = 1.5e-8, 1e-6
# Maximum number of moves along the nearest pair's normal: after a move another pair may be the
# nearest.
TANGENT_STEPS = 12


class ReferenceAnswers(NamedTuple):
    """Reference answers.

    contact, distance: (k,), verdict and signed distance [m] of the judged poses.
    tangent: (t,), verdict of the near-tangent poses.  tangent_poses: (t, 4, 4).
    """

    contact: Bools
    distance: Floats
    tangent: Bools
    tangent_poses: Floats


def find_reference(scene: Scene, measured: MeasuredScene, plan: MeasurementPlan) -> ReferenceAnswers:
    """Return the reference answers: the exact ones of a scene of the default configuration."""
    tangent = tangent_poses(scene, measured.judged, plan.near_tangent)
    distance = scene.distance(AVATAR, measured.judged, REACH).signed_distance
    return ReferenceAnswers(
        exact_contact(scene, measured.judged), distance, exact_contact(scene, tangent), tangent
    )


def tangent_poses(scene: Scene, poses: Floats, count: int) -> Floats:
    """Return poses (<= count, 4, 4) whose signed distance is within MAX_OFFSET of 0, on either side.

    Each pose is moved along the contact normal of its nearest pair, as `distance` returns it, until
    its signed distance is as small as drawn at random. Poses that do not converge are left out.
    scene: with the avatar added.
    """
    rng = np.random.default_rng([SEED, 0x7A])
    moved = poses[rng.choice(len(poses), min(len(poses), 2 * count), replace=False)].copy()
    off = np.exp(rng.uniform(np.log(MIN_OFFSET), np.log(MAX_OFFSET), len(moved))) * rng.choice(
        [-1, 1], len(moved)
    )
    settled = np.zeros(len(moved), bool)
    for _ in range(TANGENT_STEPS):
        open_ = np.flatnonzero(~settled)
        found = scene.distance(AVATAR, moved[open_], REACH)
        short = off[open_] - found.signed_distance
        settled[open_] = np.isfinite(short) & (np.abs(found.signed_distance) <= MAX_OFFSET)
        go = np.isfinite(short) & ~settled[open_]
        moved[open_[go], :3, 3] += short[go, None] * found.normal[go]
    return moved[settled][:count]


def exact_contact(scene: Scene, poses: Floats) -> NDArray[np.bool_]:
    """Return whether poses (k,) are in contact, exactly. Raises BadDataError if one is unknown."""
    verdict = scene.collide(AVATAR, poses).verdict
    if (verdict == Verdict.UNKNOWN).any():
        raise BadDataError(
            f"{int((verdict == Verdict.UNKNOWN).sum())} poses are unknown, expected none: check the scan"
        )
    return verdict == Verdict.CONTACT


def check_reference(
    archive: Archive, measured: MeasuredScene, reference: ReferenceAnswers, poses: int
) -> int:
    """Check the reference verdicts against brute force at `poses` poses.

    Brute force tests every pair of points in integers, of those scan points in the box around the
    avatar. Half of the poses are near-tangent, if there are enough. Returns the number of poses
    compared.
    Raises InternalError if a verdict differs.
    """
    lattice = archive.header.lattice
    origin = np.array(lattice.origin)
    avatar = make_avatar(measured.avatar)
    reach = round(archive.header.radius * UNITS_PER_METRE) + round(avatar.radius * UNITS_PER_METRE)
    tangent = np.linspace(0, max(len(reference.tangent) - 1, 0), min(poses // 2, len(reference.tangent)))
    others = np.linspace(0, len(reference.contact) - 1, poses - len(tangent))
    tangent, others = tangent.astype(int), others.astype(int)
    compared = np.concatenate([reference.tangent_poses[tangent], measured.judged[others]])
    expected = np.concatenate([reference.tangent[tangent], reference.contact[others]])
    voxels = VoxelSteps(archive)
    for number in np.argsort(compared[:, 0, 3], kind="stable"):
        placed = _placed_units(compared[number], measured.avatar, origin)
        around = reach / UNITS_PER_METRE + 2 * lattice.step
        low = placed.min(axis=0) / UNITS_PER_METRE - around
        high = placed.max(axis=0) / UNITS_PER_METRE + around
        steps = voxels.in_box(low + origin, high + origin)
        near = (steps >= np.floor(low / lattice.step)) & (steps <= np.ceil(high / lattice.step))
        scene = np.rint(steps[near.all(axis=1)].astype(np.float64) * lattice.units_per_step).astype(np.int64)
        scene = scene[np.argsort(scene[:, 0], kind="stable")]
        if _touches(placed, scene, reach) != expected[number]:
            raise InternalError(
                f"pose {number} of those judged: the server answers "
                f"{'contact' if expected[number] else 'clear'}, a test of every pair of points finds the "
                "opposite: this is a bug of this software, report it"
            )
    return len(compared)


class VoxelSteps:
    """Points of an archive's voxels in lattice steps; the voxels of the last box are kept."""

    def __init__(self, archive: Archive) -> None:
        """Read from an open archive."""
        self._archive = archive
        self._held: dict[int, NDArray[np.int64]] = {}

    def in_box(self, low: Floats, high: Floats) -> NDArray[np.int64]:
        """Return the points (n, 3), from the origin, of all voxels that meet a box, world frame [m]."""
        lattice = self._archive.header.lattice
        edge = lattice.voxel_size
        first = np.floor((low - np.array(lattice.origin)) / edge).astype(np.int64)
        last = np.floor((high - np.array(lattice.origin)) / edge).astype(np.int64)
        at = self._archive.coordinates
        rows = np.flatnonzero(((at >= first) & (at <= last)).all(axis=1)).tolist()
        self._held = {row: self._held.get(row, np.empty((0, 3), np.int64)) for row in rows}
        for row in rows:
            if not len(self._held[row]):
                local = voxel_points(*self._archive.read_voxel(row))
                self._held[row] = (local + at[row] * lattice.voxel_steps).astype(np.int64)
        return np.concatenate([np.empty((0, 3), np.int64), *self._held.values()])


def points_in_box(archive: Archive, low: Floats, high: Floats) -> Floats:
    """Return the scan points (n, 3) of all voxels that meet a box, world frame [m]."""
    return archive.header.lattice.to_world(VoxelSteps(archive).in_box(low, high))


def _touches(avatar: Units, scene: Units, reach: int) -> bool:
    """Return whether a pair of points is within `reach` (NUMERICS.md N5).

    avatar: (n, 3).  scene: (s, 3), sorted by x. All in exact units. Pairs farther apart than
    `reach` along x are not in reach; nor are their squares computed, which keeps these within 63
    bits.
    """
    first = np.searchsorted(scene[:, 0], avatar[:, 0] - reach)
    last = np.searchsorted(scene[:, 0], avatar[:, 0] + reach, side="right")
    for point, begin, end in zip(avatar, first, last, strict=True):
        apart = np.abs(scene[begin:end] - point)
        apart = apart[(apart <= reach).all(axis=1)]
        if ((apart * apart).sum(axis=1) <= reach * reach).any():
            return True
    return False


def _placed_units(pose: Floats, points: Floats, origin: Floats) -> Units:
    """Return points (n, 3) [m] under a pose, in exact units from the origin."""
    shift = pose[:3, 3] - origin
    x, y, z = points.T
    placed = [((m[0] * x + m[1] * y) + m[2] * z) + t for m, t in zip(pose[:3, :3], shift, strict=True)]
    return np.rint(np.stack(placed, axis=1) * UNITS_PER_METRE).astype(np.int64)
