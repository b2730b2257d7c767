"""The poses that are asked about: jittered, sorted into classes, and sets made to be hard."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from solidcloud.builder.made.truth import FacadeTruth
from solidcloud.builder.made.walk import floor_height, walk_poses

Floats = NDArray[np.float64]

JITTER = 1e-6  # [m], each repetition: no pose comes twice, none moves visibly
FAR = 0.5  # a far pose is farther than this from anything [m]
SOLE = 0.03  # feet above the floor, as on the walk [m]
SLIDING = 0.01  # between the nearest spheres of a wall and of an avatar that slides along it [m]
# About the height at which the feet touch the floor exactly [m]; 15 nm is the exact unit.
FOOT_STEPS = (-1e-3, -1e-4, -1e-5, -1e-6, -3e-8, 0.0, 3e-8, 1e-6, 1e-5, 1e-4, 1e-3)
WALK_SECONDS = 40.0
# Of `near_surfaces`: how far around a figure it is moved out of, and what gap is left [m].
AROUND, LEFT = 0.3, (-0.005, 0.05)
PILOT = 200  # poses asked to find the distance at which half of them touch


class PoseSet(NamedTuple):
    """Poses (k, 4, 4), avatar to world, under a name; said: one sentence of what they are."""

    name: str
    poses: Floats
    said: str


def jittered(poses: Floats, rng: np.random.Generator, size: float = JITTER) -> Floats:
    """The poses, each moved along each axis by at most `size` [m], at random; a new array."""
    moved = poses.copy()
    moved[:, :3, 3] += rng.uniform(-size, size, (len(poses), 3))
    return moved


def walk_at(truth: FacadeTruth, rate: float) -> Floats:
    """The walk of WALK_SECONDS at so many frames a second (k, 4, 4): the same path, sampled anew."""
    return walk_poses(truth, round(WALK_SECONDS * rate), rate)[1]


def classes(contact: NDArray[np.bool_], gaps: Floats, far: float = FAR) -> dict[str, NDArray[np.bool_]]:
    """Which poses (k,) are far, near but clear, and in contact; every pose is in one class.

    gaps: (k,) least distance of spheres [m], or any number above `far` beyond it.
    """
    away = ~contact & (gaps > far)
    return {"far": away, "clear, near": ~contact & ~away, "contact": contact}


def gaps(tree: cKDTree, avatar: Floats, local_poses: Floats, distance: float, most: float = FAR) -> Floats:
    """Least distance (k,) of the spheres of tree and avatar [m], inf beyond `most`.

    local_poses: avatar to the tree's frame.  distance: both radii together [m].
    """
    found = np.full(len(local_poses), np.inf)
    some = avatar[:: max(1, len(avatar) // 64)]
    for i, pose in enumerate(local_poses):
        # A search bounded by what a few points found is many times as fast as one bounded by `most`.
        bound = most + distance
        for points in (some, avatar):
            placed = points @ pose[:3, :3].T + pose[:3, 3]
            near = tree.query(placed, distance_upper_bound=np.nextafter(bound, np.inf))[0].min()
            bound = min(bound, near)
        found[i] = near - distance
    found[found > most] = np.inf
    return found


def upright(places: Floats, yaw: Floats) -> Floats:
    """Poses (k, 4, 4) of an avatar that stands at places (k, 3), turned about z by yaw (k,) [rad]."""
    poses = np.zeros((len(places), 4, 4))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(yaw)
    poses[:, 1, 0] = np.sin(yaw)
    poses[:, 0, 1] = -poses[:, 1, 0]
    poses[:, 2, 2] = poses[:, 3, 3] = 1.0
    poses[:, :3, 3] = places
    return poses


def random_poses(
    rng: np.random.Generator, points: Floats, avatar: Floats, count: int, farthest: float
) -> Floats:
    """Poses (count, 4, 4), rigid: a random avatar point within `farthest` [m] of a random scan point."""
    q = rng.normal(size=(count, 4))
    w, x, y, z = (q / np.linalg.norm(q, axis=1)[:, None]).T
    poses = np.zeros((count, 4, 4))
    poses[:, :3, :3] = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    away = rng.normal(size=(count, 3))
    away *= (rng.uniform(0, farthest, count) / np.linalg.norm(away, axis=1))[:, None]
    held = avatar[rng.integers(len(avatar), size=count)]
    turned = np.einsum("kij,kj->ki", poses[:, :3, :3], held)
    poses[:, :3, 3] = points[rng.integers(len(points), size=count)] + away - turned
    poses[:, 3, 3] = 1.0
    return poses


def half_touching(
    rng: np.random.Generator, points: Floats, avatar: Floats, touching: Callable[[Floats], NDArray[np.bool_]]
) -> float:
    """A distance [m] at which about half of `random_poses` touch; only a choice of poses, so the engine may tell."""
    distance = float(np.ptp(avatar, axis=0).max()) / 32
    for _ in range(12):
        if touching(random_poses(rng, points, avatar, PILOT, distance)).mean() <= 0.5:
            break
        distance *= 1.5
    return distance


def touching_shift(points: Floats, placed: Floats, axis: ArrayLike, distance: float) -> float:
    """How far along a unit axis to move centres placed (m, 3) so that the nearest pair is `distance` apart [m].

    Moved farther, no pair is as near as that. -inf where no pair can be, for all lie beside one another.
    """
    u = np.asarray(axis, np.float64)
    across = np.linalg.svd(u[None])[2][1:]  # two directions square to the axis
    at = placed @ across.T
    low, high = at.min(axis=0) - distance, at.max(axis=0) + distance
    flat = points @ across.T
    near = ((flat >= low) & (flat <= high)).all(axis=1)
    if not near.any():
        return -np.inf
    tree, heights = cKDTree(flat[near]), points[near] @ u
    pairs = cKDTree(at).sparse_distance_matrix(tree, distance, output_type="ndarray")
    if not len(pairs):
        return -np.inf
    rise = np.sqrt(np.maximum(distance * distance - pairs["v"] ** 2, 0.0))
    return float((heights[pairs["j"]] - placed[pairs["i"]] @ u + rise).max())


def _placed(avatar: Floats, pose: Floats) -> Floats:
    return avatar @ pose[:3, :3].T + pose[:3, 3]


def feet_on_floor(
    points: Floats, avatar: Floats, walk: Floats, distance: float, count: int, feet: float = 0.25
) -> PoseSet:
    """Poses of the walk lowered to where the feet just touch what is below them, and a little above and below it.

    points, walk: one frame.  walk: poses in contact with nothing.  feet: how far above the soles a point of the
    scan may lie to count as below [m].
    """
    found = []
    for k, i in enumerate(np.linspace(0, len(walk) - 1, min(count, len(walk))).astype(int)):
        pose = walk[i].copy()
        placed = _placed(avatar, pose)
        low = points[points[:, 2] < placed[:, 2].min() + feet]
        shift = touching_shift(low, placed, (0.0, 0.0, 1.0), distance)
        if np.isfinite(shift):
            pose[2, 3] += shift + FOOT_STEPS[k % len(FOOT_STEPS)]
            found.append(pose)
    return PoseSet(
        "feet on the floor",
        np.array(found).reshape(-1, 4, 4),
        "at the height of contact, and up to 1 mm above and below",
    )


def along_walls(
    points: Floats, avatar: Floats, truth: FacadeTruth, distance: float, rng: np.random.Generator, count: int
) -> PoseSet:
    """Poses 1 cm from each wall of the façade, all along it, turned at random; points in the truth's own frame."""
    found = []
    for wall in truth.walls:
        axis = 0 if wall.axis == "x" else 1
        normal = np.zeros(3)
        normal[axis] = wall.facing
        for along in np.linspace(wall.low + 0.4, wall.high - 0.4, -(-count // len(truth.walls))):
            place = np.full(3, along)
            place[axis] = wall.offset + 0.5 * wall.facing
            place[2] = floor_height(truth, place[None, :2])[0] + SOLE
            pose = upright(place[None], rng.uniform(-np.pi, np.pi, 1))[0]
            of_wall = points[np.abs(points[:, axis] - wall.offset) < 0.15]
            shift = touching_shift(of_wall, _placed(avatar, pose), normal, distance + SLIDING)
            if np.isfinite(shift):
                pose[:3, 3] += shift * normal
                found.append(pose)
    return PoseSet(
        "along walls", np.array(found).reshape(-1, 4, 4), "1 cm from a wall, feet 3 cm above the floor"
    )


def inside_columns(truth: FacadeTruth, rng: np.random.Generator, count: int) -> PoseSet:
    """Poses in the axis of a column, turned at random, somewhere in its height; in the truth's own frame."""
    chosen = [truth.columns[i] for i in rng.integers(len(truth.columns), size=count)]
    places = np.array([(c.x, c.y, rng.uniform(c.z_low, c.z_high)) for c in chosen])
    return PoseSet("inside columns", upright(places, rng.uniform(-np.pi, np.pi, count)), "in a column's axis")


def near_surfaces(
    tree: cKDTree, points: Floats, avatar: Floats, distance: float, rng: np.random.Generator, count: int
) -> PoseSet:
    """Poses turned at random, moved along a random direction out of what is around them until a small gap is left.

    tree: over points (n, 3), the frame of the poses. What was not around may be touched: some are in contact.
    """
    centre = avatar.mean(axis=0)
    around = float(np.linalg.norm(avatar - centre, axis=1).max()) + AROUND
    poses = random_poses(rng, points, avatar, count, AROUND)
    axes = rng.normal(size=(count, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    left = rng.uniform(*LEFT, count)
    moved: NDArray[np.bool_] = np.zeros(count, bool)
    for i, (pose, axis, gap) in enumerate(zip(poses, axes, left, strict=True)):
        near = tree.query_ball_point(pose[:3, :3] @ centre + pose[:3, 3], around)
        shift = touching_shift(points[near], _placed(avatar, pose), axis, distance + gap)
        moved[i] = np.isfinite(shift)  # not where all that is around lies beside it
        if moved[i]:
            pose[:3, 3] += shift * axis
    low, high = (f"{edge * 1e3:g}" for edge in LEFT)
    said = f"turned at random, moved out of what is within {AROUND:g} m to a gap of {low} to {high} mm"
    return PoseSet("near surfaces", poses[moved], said)


def free_space(
    tree: cKDTree,
    bounds: Floats,
    avatar: Floats,
    distance: float,
    rng: np.random.Generator,
    count: int,
    far: float,
) -> PoseSet:
    """Upright poses at random within bounds (2, 3), that have nothing within `far` [m]; 0: that touch nothing."""
    found = np.empty((0, 4, 4))
    for _ in range(20):
        poses = upright(rng.uniform(bounds[0], bounds[1], (count, 3)), rng.uniform(-np.pi, np.pi, count))
        clear = gaps(tree, avatar, poses, distance, max(far, 1e-3)) > far
        found = np.concatenate([found, poses[clear]])[:count]
        if len(found) == count:
            break
    what = f"nothing within {far:g} m" if far else "touching nothing"
    return PoseSet("far" if far else "free space", found, f"at random within the façade's bounds, {what}")
