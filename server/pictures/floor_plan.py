"""Floor plan of a scene: the scan from above between two heights, and poses marked by verdict.

matplotlib, of the extra `report`, is imported when a plan is drawn.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.pose_arrays import make_poses
from ...schemas.errors import BadRequestError, SolidcloudError
from ...schemas.wire.answers import CollideAnswers, Verdict
from ...schemas.wire.scene_messages import SceneInfo
from ..archives.placed_archive import PlacedArchive
from ..avatars.avatar_model import AvatarModel
from .plan_points import PlanPoints, read_plan_points

_Floats = NDArray[np.float64]

# Marker, face and edge of each verdict. Shape and lightness differ, so that a print in grey can be
# read, and so can those who do not tell red from green.
_MARKERS = {
    Verdict.CLEAR: ("o", "#9ad1ea", "#2f7391"),
    Verdict.CONTACT: ("X", "#a50f26", "#4d0410"),
    Verdict.UNKNOWN: ("^", "#ffe08a", "#6b5200"),
}
_PAPER, _STONES, _BOX = "#fdfcfa", ("#c4b8a4", "#978770", "#5f5140"), "#ece7df"
# Pixels along the longer side of the scan's image: at most, and at least. Between these, a pixel is as
# wide as the scan's spheres, so that a wall is a line.
_MOST_PIXELS, _LEAST_PIXELS = 500, 100
# Margin around the poses: the share of their extent, and the least [m].
_MARGIN, _LEAST_MARGIN = 0.25, 2.0
# Height above the feet at which the slice begins, so that the floor is left out: the share of the
# avatar's height, and the most [m].
_ABOVE_FLOOR, _MOST_ABOVE_FLOOR = 0.1, 0.15
# Poses at which an avatar's heights are measured, at most.
_MEASURED_POSES = 64
# Size of the picture [inches] and its resolution.
_WIDTH, _LEAST_HEIGHT, _MOST_HEIGHT, _DPI = 8.0, 4.0, 10.0, 120


class Marks(NamedTuple):
    """Poses in a plan. poses: (k, 4, 4), avatar to world.  verdict: (k,) uint8."""

    poses: _Floats
    verdict: NDArray[np.uint8]


class PlanAxes(NamedTuple):
    """Axes of a plan: world axes to the right, upwards in the picture, and of the heights.

    turned: whether the vertical axis of the picture points down, so that the plan is seen from above.
    """

    right: int
    ahead: int
    height: int
    sign: float
    turned: bool


def plan_axes(up: Sequence[float]) -> PlanAxes:
    """Return the axes of a plan. up: against gravity; the world axis nearest to it is used."""
    height = int(np.argmax(np.abs(up)))
    right, ahead = (axis for axis in range(3) if axis != height)
    sign = 1.0 if up[height] > 0 else -1.0
    return PlanAxes(right, ahead, height, sign, (sign < 0) != (height == 1))


def standing_heights(points: _Floats, poses: _Floats, axes: PlanAxes) -> tuple[float, float] | None:
    """Return the range of heights that an avatar takes, without the floor below its feet [m].

    points: (n, 3) of the avatar [m].  Return None without poses. The heights are those of the
    median pose.
    """
    if not len(poses):
        return None
    some = poses[:: -(-len(poses) // _MEASURED_POSES)]
    heights = (some[:, axes.height, :3] @ points.T + some[:, axes.height, 3:4]) * axes.sign
    low, high = float(np.median(heights.min(axis=1))), float(np.median(heights.max(axis=1)))
    return low + min(_MOST_ABOVE_FLOOR, _ABOVE_FLOOR * (high - low)), high


class PlottedScene(Protocol):
    """Scene in this process, as `Scene`."""

    name: str
    archives: list[PlacedArchive]

    def info(self) -> SceneInfo: ...
    def avatar(self, name: str, client: str) -> AvatarModel: ...
    def collide(self, name: str, poses: Any, margin: float = 0.0, *, client: str) -> CollideAnswers: ...


def plot_scene(
    scene: PlottedScene,
    avatar: str | None,
    poses: Any,
    answers: Any,
    heights: tuple[float, float] | None,
    axes: Any,
    most: int,
    client: str,
) -> Any:
    """Draw a plan of a scene for `Scene.plot`, and return the figure. most: number of points to read."""
    array = make_poses(np.empty((0, 4, 4)) if poses is None else poses)
    if not np.isfinite(array).all():
        raise BadRequestError("a pose that is not finite: expected finite numbers")
    if answers is None and len(array):
        if avatar is None:
            raise BadRequestError(
                "poses without an avatar: expected its name, or the answers about the poses"
            )
        answers = scene.collide(avatar, array, client=client)
    verdict = np.empty(0, np.uint8) if answers is None else answers.verdict
    if len(verdict) != len(array):
        raise BadRequestError(f"{len(verdict)} answers about {len(array)} poses: expected equal numbers")
    info = scene.info()
    plan = plan_axes(info.up)
    if heights is None and avatar is not None:
        heights = standing_heights(scene.avatar(avatar, client).points, array, plan)
    return draw_plan(scene.archives, info, plan, Marks(array, verdict), heights, most, axes)


def draw_plan(
    archives: Sequence[PlacedArchive],
    info: SceneInfo,
    plan: PlanAxes,
    marks: Marks,
    heights: tuple[float, float] | None,
    most: int,
    axes: Any = None,
) -> Any:
    """Draw a floor plan, and return matplotlib's figure.

    info: description of the scene.  marks: poses to mark, perhaps none.
    heights: range of heights to draw [m]; None: all.  most: points to read, see plan_points.py.
    axes: matplotlib's axes to draw into; None: those of a new figure.
    Raise SolidcloudError if matplotlib is not installed.
    """
    figure_type = _figure_type()
    positions = marks.poses[:, :3, 3]
    shown = [plan.right, plan.ahead]
    low, high = _region(np.array(info.bounds), positions, shown)
    if heights is not None:
        low[plan.height], high[plan.height] = sorted(plan.sign * height for height in heights)
    near = positions if len(positions) else (low + high)[None] / 2
    found = read_plan_points(archives, low, high, near, most)
    own = axes is None
    if own:
        across, along = (high - low)[shown]
        height = float(np.clip(_WIDTH * along / max(across, 1e-9), _LEAST_HEIGHT, _MOST_HEIGHT))
        figure = figure_type(
            figsize=(_WIDTH, height + 1.0), dpi=_DPI, facecolor="white", layout="constrained"
        )
        axes = figure.subplots()
    _draw_scan(axes, found, low[shown], high[shown], shown, info.radius)
    _draw_marks(axes, marks, shown)
    axes.set_xlim(low[shown[0]], high[shown[0]])
    ends = low[plan.ahead], high[plan.ahead]
    axes.set_ylim(*(ends[::-1] if plan.turned else ends))
    axes.set_aspect("equal")
    axes.set_xlabel(f"{'xyz'[plan.right]} [m]")
    axes.set_ylabel(f"{'xyz'[plan.ahead]} [m]")
    name = "xyz"[plan.height]
    where = "" if heights is None else f", {name} from {low[plan.height]:.2f} to {high[plan.height]:.2f} m"
    axes.set_title(f"{info.scene}: plan{where}")
    figure = axes.figure
    if len(positions) and own:
        figure.legend(loc="outside lower center", ncols=3, frameon=False)
    elif len(positions):
        axes.legend()
    return figure


def write_figure(figure: Any, path: Path) -> None:
    """Write a figure in the format that the path's suffix names. Raise SolidcloudError."""
    try:
        figure.savefig(path)
    except (ValueError, OSError) as error:
        raise SolidcloudError(f"{path}: cannot write the plan ({error}): choose another path") from error


def _figure_type() -> Any:
    """Return matplotlib's Figure. Raise SolidcloudError if matplotlib is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise SolidcloudError(
            f"matplotlib, which draws plans, is missing ({error}), expected it to be installed: pip install "
            "'solidcloud[report]'"
        ) from error
    return Figure


def _region(bounds: _Floats, positions: _Floats, shown: list[int]) -> tuple[_Floats, _Floats]:
    """Return the low and high corner (3,) of the region to draw [m].

    That is the surroundings of the positions (k, 3) at all heights, or the whole scene without any.
    shown: the axes of the plan.
    """
    low, high = bounds[0].copy(), bounds[1].copy()
    if len(positions):
        first, last = positions[:, shown].min(axis=0), positions[:, shown].max(axis=0)
        around = max(_LEAST_MARGIN, _MARGIN * float((last - first).max()))
        low[shown] = np.minimum(np.maximum(low[shown], first - around), first - _LEAST_MARGIN / 4)
        high[shown] = np.maximum(np.minimum(high[shown], last + around), last + _LEAST_MARGIN / 4)
    edge = 0.02 * float((high - low).max()) + 1e-3
    return low - edge, high + edge


def _draw_scan(
    axes: Any, found: PlanPoints, low: _Floats, high: _Floats, shown: list[int], radius: float
) -> None:
    """Draw the points as an image of their density, and boxes where points were not read.

    low, high: (2,) of the plan [m].  radius: of the scan's spheres [m].
    """
    from matplotlib.collections import PolyCollection
    from matplotlib.colors import LinearSegmentedColormap

    axes.set_facecolor(_PAPER)
    if len(found.boxes):
        (x0, y0), (x1, y1) = found.boxes[:, 0][:, shown].T, found.boxes[:, 1][:, shown].T
        corners: Any = np.stack(
            [np.stack(xy, axis=1) for xy in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))], axis=1
        )
        axes.add_collection(
            PolyCollection(corners, facecolor=_BOX, edgecolor="#d8d0c4", linewidth=0.4, zorder=1)
        )
    extent = float((high - low).max())
    pixel = min(max(2 * radius, extent / _MOST_PIXELS), extent / _LEAST_PIXELS)
    edges: Any = [np.arange(a, b + pixel, pixel) for a, b in zip(low, high, strict=True)]
    x, y = found.points[:, shown[0]], found.points[:, shown[1]]
    counts, _, _ = np.histogram2d(x, y, bins=edges)
    image = np.ma.masked_equal(np.log1p(counts.T), 0.0)
    if image.count():
        axes.imshow(
            image,
            origin="lower",
            extent=(edges[0][0], edges[0][-1], edges[1][0], edges[1][-1]),
            cmap=LinearSegmentedColormap.from_list("stone", _STONES),
            vmin=0.0,
            vmax=float(np.quantile(image.compressed(), 0.95)),
            interpolation="nearest",
            zorder=2,
        )


def _draw_marks(axes: Any, marks: Marks, shown: list[int]) -> None:
    """Mark the poses by verdict, contacts on top, and label each kind with its number."""
    k = len(marks.poses)
    if not k:
        return
    at = marks.poses[:, shown, 3]
    size = float(np.clip(6000 / k, 12, 70))
    for order, verdict in enumerate((Verdict.CLEAR, Verdict.UNKNOWN, Verdict.CONTACT)):
        chosen = marks.verdict == verdict
        if not chosen.any():
            continue
        marker, face, edge = _MARKERS[verdict]
        axes.scatter(
            *at[chosen].T,
            s=size * (1.0 if verdict is Verdict.CLEAR else 2.0),
            marker=marker,
            facecolor=face,
            edgecolor=edge,
            linewidth=size / 100,
            zorder=4 + order,
            label=f"{verdict.name.lower()}: {int(chosen.sum()):,}",
        )
