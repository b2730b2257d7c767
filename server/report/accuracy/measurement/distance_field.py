"""`collide` from a Euclidean distance field, which robots use: time, memory and wrong verdicts on three grids.

The field holds, for each cell, the distance from its centre to the nearest cell with a scan point.
A pose is in contact if the value at the cell of some avatar point is at most the sum of the radii.
It covers a box around the part of the walk with the most poses.
"""

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .....schemas.archive.archive import Archive
from .....schemas.errors import InternalError
from .....schemas.runtime.compiling import njit
from ....scene import Scene
from ...common.paired_times import Floats, mean_ratio, time_in_turn
from .accuracy_results import FieldRow
from .measured_scene import AVATAR
from .measurement_plan import MeasurementPlan
from .pose_classes import class_members, timed_poses
from .reference_answers import ReferenceAnswers, points_in_box

# Space around the avatar in the box, and the height that poses may differ by from its middle [m].
AROUND, CLIMB = 0.3, 0.5
# A box holds few of a long walk's poses: smaller classes are measured than elsewhere.
FEW = 5


class DistanceField(NamedTuple):
    """A distance field: values (x, y, z) float32 [m], the low corner of its first cell (3,) [m], edge [m]."""

    values: NDArray[np.float32]
    low: Floats
    cell: float


def make_field(points: Floats, low: Floats, high: Floats, cell: float) -> DistanceField:
    """Return the field of points (n, 3) over the box from `low` to `high` (3,) [m]."""
    from scipy.ndimage import distance_transform_edt

    shape = np.maximum(1, np.ceil((high - low) / cell).astype(np.int64))
    index = np.floor((points - low) / cell).astype(np.int64)
    index = index[((index >= 0) & (index < shape)).all(axis=1)]
    free = np.ones(shape, bool)
    free[tuple(index.T)] = False
    # Without any point all values would be 0.
    values = distance_transform_edt(free, sampling=cell) if len(index) else np.full(shape, np.inf)
    return DistanceField(values.astype(np.float32), low, cell)


@njit(cache=True)
def _touches(
    values: NDArray[np.float32],
    low: Floats,
    cell: float,
    avatar: Floats,
    poses: Floats,
    threshold: float,
    touch: NDArray[np.bool_],
) -> None:
    """Fill touch (k,): whether the value at some avatar point (n, 3) is at most `threshold` [m]."""
    for p in range(len(poses)):
        pose, found = poses[p], False
        for a in range(len(avatar)):
            x, y, z = avatar[a, 0], avatar[a, 1], avatar[a, 2]
            i = int((pose[0, 0] * x + pose[0, 1] * y + pose[0, 2] * z + pose[0, 3] - low[0]) / cell)
            j = int((pose[1, 0] * x + pose[1, 1] * y + pose[1, 2] * z + pose[1, 3] - low[1]) / cell)
            k = int((pose[2, 0] * x + pose[2, 1] * y + pose[2, 2] * z + pose[2, 3] - low[2]) / cell)
            if values[i, j, k] <= threshold:
                found = True
                break
        touch[p] = found


def field_touches(field: DistanceField, avatar: Floats, poses: Floats, threshold: float) -> NDArray[np.bool_]:
    """Return whether the avatar (n, 3) touches under poses (k, 4, 4), all within the field."""
    touch = np.zeros(len(poses), np.bool_)
    _touches(field.values, field.low, field.cell, avatar, poses, threshold, touch)
    return touch


def field_box(
    avatar: Floats, poses: Floats, distance: Floats, cells: int, cell: float
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return a box of at most `cells` cells around poses (k, 4, 4), of as many classes and poses as possible.

    distance: (k,) signed, of the poses [m].
    Returns its low and high corner (3,) [m], and which poses it holds with the avatar (n, 3).
    """
    across = float(np.hypot(*np.abs(avatar[:, :2]).max(axis=0))) + AROUND
    below, above = float(avatar[:, 2].min()) - AROUND, float(avatar[:, 2].max()) + AROUND
    places = poses[:, :3, 3]
    best, most = (np.zeros(3), np.zeros(3), np.zeros(len(poses), bool)), (0, 0)
    for centre in places[:: max(1, len(places) // 60)]:
        # As high as the avatar, and CLIMB more on each side; as wide as the cells suffice.
        low_z, high_z = centre[2] + below - CLIMB, centre[2] + above + CLIMB
        wide = (cells * cell**3 / (high_z - low_z)) ** 0.5 - 2 * cell
        low = np.array([centre[0] - wide / 2, centre[1] - wide / 2, low_z])
        high = np.array([centre[0] + wide / 2, centre[1] + wide / 2, high_z])
        inside = (np.abs(places[:, :2] - centre[:2]) <= wide / 2 - across).all(axis=1)
        inside &= np.abs(places[:, 2] - centre[2]) <= CLIMB
        found = len(class_members(distance[inside], FEW)), int(inside.sum())
        if found > most:
            best, most = (low, high, inside), found
    return best


def field_rows(
    archive: Archive,
    scene: Scene,
    avatar: Floats,
    poses: Floats,
    reference: ReferenceAnswers,
    plan: MeasurementPlan,
    tick: Callable[[], None],
) -> list[FieldRow]:
    """Measure the fields of the plan's cells on the judged poses (k, 4, 4) in one box.

    scene: with the avatar added, for the exact answer's time.  tick: called after each field.
    Returns no rows if the box holds no class of poses.
    """
    low, high, inside = field_box(avatar, poses, reference.distance, plan.field_cells, min(plan.cells))
    kinds = class_members(np.where(inside, reference.distance, np.nan), FEW)
    reach = scene.info().radius + (scene.add_avatar(AVATAR, avatar).radius or 0.0)
    points = points_in_box(archive, low, high)
    scene_low, scene_high = np.array(scene.info().bounds)
    found = []
    for cell in plan.cells:
        begin = time.perf_counter()
        field = make_field(points, low, high, cell)
        seconds = time.perf_counter() - begin
        whole = int(np.prod(np.ceil((scene_high - scene_low) / cell))) * 4
        # A point and the centre of its cell are at most half a diagonal apart, twice.
        safe = reach + 3**0.5 * cell
        for kind, rows in kinds.items():
            own, contact = timed_poses(poses[rows]), reference.contact[rows]
            spent = time_in_turn(
                [partial(scene.collide, AVATAR, own), partial(field_touches, field, avatar, own, reach)],
                plan.rounds,
            )
            plain = field_touches(field, avatar, poses[rows], reach)
            wide = field_touches(field, avatar, poses[rows], safe)
            if (contact & ~wide).any():
                raise InternalError(
                    f"a distance field of {cell:g} m calls a touching pose clear beyond its error, expected none: "
                    "this is a bug of this software, report it"
                )
            found.append(
                FieldRow(
                    cell, kind, len(rows) / len(poses), float(np.median(spent[:, 1])) / len(own) * 1e6,
                    mean_ratio(spent[:, 1] / spent[:, 0]).ratio, float((contact & ~plain).mean()),
                    float((plain & ~contact).mean()), float((wide & ~contact).mean()), field.values.nbytes, whole,
                    seconds,
                )
            )  # fmt: skip
        tick()
    return found
