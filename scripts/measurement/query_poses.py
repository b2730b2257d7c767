"""Query poses: jittered, sorted into classes, and sets designed to be hard."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree
from solidcloud.builder.synthetic.truth import FacadeTruth
from solidcloud.builder.synthetic.walk import floor_height, walk_poses

Floats = NDArray[np.float64]

JITTER = 1e-6  # [m] per repetition: no pose occurs twice, none moves visibly
FAR = 0.5  # a far pose is farther than this from all points [m]
SOLE = 0.03  # feet above the floor, as on the walk [m]
SLIDING = 0.01  # gap between the nearest spheres of a wall and an avatar that slides along it [m]
# Offsets from the height at which the feet touch the floor exactly [m]; 15 nm is the exact unit.
FOOT_STEPS = (-1e-3, -1e-4, -1e-5, -1e-6, -3e-8, 0.0, 3e-8, 1e-6, 1e-5, 1e-4, 1e-3)
WALK_SECONDS = 40.0
# Parameters of `near_surfaces`: the surroundings out of which a figure is moved, and the gap left
# [m].
AROUND, LEFT = 0.3, (-0.005, 0.05)
PILOT = 200  # poses tried to find the distance at which half of them touch


class PoseSet(NamedTuple):
    """Named poses (k, 4, 4), avatar to world; said: a one-sentence description."""

    name: str
    poses: Floats
    said: str


def jittered(poses: Floats, rng: np.random.Generator, size: float = JITTER) -> Floats:
    """Return a copy of the poses, each moved at random along each axis by at most `size` [m]."""
    moved = poses.copy()
    moved[:, :3, 3] += rng.uniform(-size, size, (len(poses), 3))
    return moved


def walk_at(truth: FacadeTruth, rate: float) -> Floats:
    """Return the walk of WALK_SECONDS at this frame rate (k, 4, 4): the same path, resampled."""
    return walk_poses(truth, round(WALK_SECONDS * rate), rate)[1]


def classes(contact: NDArray[np.bool_], gaps: Floats, far: float = FAR) -> dict[str, NDArray[np.bool_]]:
    """Classify poses (k,) as far, near but clear, and in contact; every pose is in one class.

    gaps: (k,) least distance of spheres [m], or any number above `far` beyond it.
    """
    away = ~contact & (gaps > far)
    return {"far": away, "clear, near": ~contact & ~away, "contact": contact}


def gaps(tree: cKDTree, avatar: Floats, local_poses: Floats, distance: float, most: float = FAR) -> Floats:
    """Return the least distance (k,) of the spheres of tree and avatar [m], inf beyond `most`.

    local_poses: avatar to the tree's frame.
    distance: sum of both radii [m].
    """
    found = np.full(len(local_poses), np.inf)
    some = avatar[:: max(1, len(avatar) // 64)]
    for i, pose in enumerate(local_poses):
        # A search bounded by the result of a few points is many times as fast as one bounded by
        # `most`.
        bound = most + distance
        for points in (some, avatar):
            placed = points @ pose[:3, :3].T + pose[:3, 3]
            near = tree.query(placed, distance_upper_bound=np.nextafter(bound, np.inf))[0].min()
            bound = min(bound, near)
        found[i] = near - distance
    found[found > most] = np.inf
    return found


def upright(places: Floats, yaw: Floats) -> Floats:
    """Return poses (k, 4, 4) of an avatar upright at places (k, 3), turned about z by yaw (k,) [rad]."""
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
    """Return rigid poses (count, 4, 4) with random avatar points near random scan points.

    farthest: maximum distance of the two points [m].
    """
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
    """Return a distance [m] at which about half of `random_poses` touch.

    This only selects poses, and the engine may therefore decide it.
    """
    distance = float(np.ptp(avatar, axis=0).max()) / 32
    for _ in range(12):
        if touching(random_poses(rng, points, avatar, PILOT, distance)).mean() <= 0.5:
            break
        distance *= 1.5
    return distance


def touching_shift(points: Floats, placed: Floats, axis: ArrayLike, distance: float) -> float:
    """Return the shift along a unit axis that brings the nearest pair to `distance` [m].

    placed: (m, 3) centres to move.
    A larger shift brings no pair that near. -inf where no pair can be, because all points lie to
    the side.
    """
    u = np.asarray(axis, np.float64)
    across = np.linalg.svd(u[None])[2][1:]  # two directions perpendicular to the axis
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
    """Return poses of the walk lowered to the exact contact of the feet, and to slight offsets from it.

    points, walk: in one frame.
    walk: poses without contact.
    feet: maximum height above the soles of a scan point that counts as below the feet [m].
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
    """Return poses 1 cm from each wall of the façade, distributed along it, with random rotations.

    points: in the truth's own frame.
    """
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
    """Return poses on the axis of a column, with random rotation and height; in the truth's own frame."""
    chosen = [truth.columns[i] for i in rng.integers(len(truth.columns), size=count)]
    places = np.array([(c.x, c.y, rng.uniform(c.z_low, c.z_high)) for c in chosen])
    return PoseSet("inside columns", upright(places, rng.uniform(-np.pi, np.pi, count)), "in a column's axis")


def near_surfaces(
    tree: cKDTree, points: Floats, avatar: Floats, distance: float, rng: np.random.Generator, count: int
) -> PoseSet:
    """Return randomly rotated poses, moved out of their surroundings until a small gap is left.

    tree: over points (n, 3), in the frame of the poses.
    The direction of motion is random. A pose may touch points outside its initial surroundings:
    some are in contact.
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
        moved[i] = np.isfinite(shift)  # not where all surrounding points lie to the side
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
    """Return random upright poses within bounds (2, 3) that have nothing within `far` [m].

    far: 0 for poses that touch nothing.
    """
    found = np.empty((0, 4, 4))
    for _ in range(20):
        poses = upright(rng.uniform(bounds[0], bounds[1], (count, 3)), rng.uniform(-np.pi, np.pi, count))
        clear = gaps(tree, avatar, poses, distance, max(far, 1e-3)) > far
        found = np.concatenate([found, poses[clear]])[:count]
        if len(found) == count:
            break
    what = f"nothing within {far:g} m" if far else "touching nothing"
    return PoseSet("far" if far else "free space", found, f"at random within the façade's bounds, {what}")
