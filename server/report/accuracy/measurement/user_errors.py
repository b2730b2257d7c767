"""Measurement of the two errors that users notice: doorways too narrow, and walls that leak."""

import math
from collections.abc import Callable
from pathlib import Path

from ...common.doorway import doorway_error
from ...common.measured_doorway import measure_doorways
from ...common.wall_leak import leak, leak_places
from .engine_settings import Archives, Setting
from .measured_scene import AVATAR, SEED, MeasuredScene
from .measurement_plan import MeasurementPlan
from .setting_results import BUDGET, DEGREE, LEAF, NODES, RADIUS, STEP, TOLERANCE

# Knobs that change no answer: their settings have the errors of the default.
NO_EFFECT_KNOBS = (DEGREE, LEAF, NODES)
USER_ERROR_KNOBS = (TOLERANCE, BUDGET, STEP, RADIUS)
DOOR = "main"
# Approximate number of façades that `measure_generated_doors` generates: twelve for the first model, and a few
# for each of three others.
FACADES = 20


def measure_user_errors(
    settings: list[Setting],
    archives: Archives,
    measured: MeasuredScene,
    plan: MeasurementPlan,
    tick: Callable[[], None],
) -> None:
    """Fill in the doorway error and the leak of each setting; nothing if there is no ground truth.

    The doorway error is defined for the generated figure. With another avatar only the leak is
    measured, which uses a ball instead of the avatar.
    """
    if measured.truth is None:
        return
    places = leak_places(measured.truth, places=plan.places)
    facade = measured.truth.facades[0]
    for setting in settings:
        if setting.row.knob not in USER_ERROR_KNOBS:
            continue
        scene, row = archives.scene(setting.config), setting.row
        if measured.is_figure:
            row.doorway_mm = doorway_error(scene, AVATAR, facade, door=DOOR, **setting.options).error
            if math.isinf(row.doorway_mm):
                row.note = "the figure cannot stand in the door"
        found = leak(scene, places, **setting.options)
        row.leak_p50_mm, row.leak_p99_mm, row.leak_worst_mm = found.p50, found.p99, found.worst
        row.leak_share = found.passed
        tick()
    default = next(s.row for s in settings if s.row.knob == TOLERANCE and s.row.default)
    for setting in settings:
        if setting.row.knob in NO_EFFECT_KNOBS:
            row = setting.row
            row.doorway_mm, row.leak_share = default.doorway_mm, default.leak_share
            row.leak_p50_mm, row.leak_p99_mm, row.leak_worst_mm = (
                default.leak_p50_mm, default.leak_p99_mm, default.leak_worst_mm,
            )  # fmt: skip


def measure_generated_doors(
    settings: list[Setting], folder: Path, plan: MeasurementPlan, tick: Callable[[], None]
) -> None:
    """Fill in the doorway errors measured on generated doors, for the plan's models.

    The other doorway error, of doorway.py, is inferred from one wide door.
    folder: an empty folder for the façades.  tick: called after each façade.
    """
    own = {s.row.setting: s for s in settings if s.row.knob == RADIUS and s.row.setting in plan.made_models}
    if not own:
        return
    config = next(iter(own.values())).config
    found = measure_doorways(folder, config, list(own), points=plan.points, seed=SEED, tick=tick)
    for model, doorway in found.items():
        own[model].row.made_doorway_mm = doorway.error
