"""Errors of the radius models that users notice: doorways too narrow, and walls that leak."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

from .....builder.config import BuildConfig
from ....scene import Scene
from ...common.doorway import doorway_error
from ...common.measured_doorway import measure_doorways
from ...common.paired_times import time_in_turn
from ...common.wall_leak import leak, leak_places
from .accuracy_results import RadiusRow
from .measured_scene import AVATAR, SEED, MeasuredScene
from .measurement_plan import MeasurementPlan
from .pose_classes import timed_poses

MODELS = ("mean", "local", "border", "local+border")
# Stored models that the settings combine.
STORED = frozenset({"mean", "local", "border"})
DOOR = "main"
# Approximate number of façades that `made_doorways` generates: twelve for the first model, and a few for each of
# three others.
FACADES = 20


def radius_settings(factors: tuple[float, ...], radius: float) -> list[tuple[str, str, float]]:
    """Return the model, setting and factor of each measurement. radius: that of `mean` [m]."""
    found = [(m, m if factor == 1.0 else f"{m}:{factor:g}", factor) for m in MODELS for factor in factors]
    return found + [("fixed", f"fixed:{float(f'{radius * factor:.2g}'):g}", factor) for factor in factors]


def radius_rows(
    archive: Path, measured: MeasuredScene, plan: MeasurementPlan, tick: Callable[[], None]
) -> list[RadiusRow]:
    """Measure each radius model with the plan's factors; none without ground truth.

    archive: of the façade, with the radius models STORED.  tick: called after each setting.
    """
    if measured.truth is None:
        return []
    places = leak_places(measured.truth, places=plan.walls)
    facade = measured.truth.facades[0]
    poses = timed_poses(measured.judged)
    with Scene.open(archive) as scene:
        scene.add_avatar(AVATAR, measured.avatar)
        settings = radius_settings(plan.factors, scene.info().radius)
        calls = [partial(scene.collide, AVATAR, poses, radius_model=setting) for _, setting, _ in settings]
        times = time_in_turn(calls, plan.rounds).min(axis=0) / len(poses) * 1e6
        rows = []
        for (model, setting, factor), time_us in zip(settings, times.tolist(), strict=True):
            doorway = None
            if measured.is_figure:
                doorway = doorway_error(scene, AVATAR, facade, door=DOOR, radius_model=setting).error
            found = leak(scene, places, radius_model=setting)
            rows.append(RadiusRow("façade", model, setting, factor, time_us, doorway, None, *found))
            tick()
    return rows


def count_settings(plan: MeasurementPlan) -> int:
    """Return the number of rows of `radius_rows`."""
    return (len(MODELS) + 1) * len(plan.factors)


def with_made_doorways(
    rows: list[RadiusRow],
    folder: Path,
    config: BuildConfig,
    plan: MeasurementPlan,
    tick: Callable[[], None],
) -> list[RadiusRow]:
    """Return the rows with the doorway errors of the plan's models measured on generated doors.

    The other doorway error, of doorway.py, is inferred from one wide door.
    folder: an empty folder for the façades.  config: of their builds.  tick: called after each façade.
    """
    own = [row.setting for row in rows if row.setting in plan.made_models]
    found = measure_doorways(folder, config, own, points=plan.points, seed=SEED, tick=tick)
    return [
        row._replace(made_doorway_mm=found[row.setting].error) if row.setting in found else row
        for row in rows
    ]
