"""Measurement of the two errors that users notice: doorways too narrow, and walls that leak."""

import math
from collections.abc import Callable
from pathlib import Path

from ..common.doorway import doorway_error
from ..common.leak import leak, leak_places
from ..common.made_doorway import made_doorways
from .accuracy_case import AVATAR, SEED, Ground
from .accuracy_engine import Archives, Setting
from .accuracy_plan import Plan
from .accuracy_row import BUDGET, DEGREE, LEAF, NODES, RADIUS, STEP, TOLERANCE

# Knobs that change no answer: their settings have the errors of the default.
ALIKE = (DEGREE, LEAF, NODES)
FELT = (TOLERANCE, BUDGET, STEP, RADIUS)
DOOR = "main"
# Approximate number of façades that `measure_made` generates: twelve for the first model, and a few
# for each of three others.
FACADES = 20


def measure_felt(
    settings: list[Setting], archives: Archives, ground: Ground, plan: Plan, tick: Callable[[], None]
) -> None:
    """Fill in the doorway error and the leak of each setting; nothing if there is no ground truth.

    The doorway error is defined for the generated figure. With another avatar only the leak is
    measured, which uses a ball instead of the avatar.
    """
    if ground.truth is None:
        return
    places = leak_places(ground.truth, places=plan.places)
    facade = ground.truth.facades[0]
    for setting in settings:
        if setting.row.knob not in FELT:
            continue
        scene, row = archives.scene(setting.config), setting.row
        if ground.own:
            row.doorway_mm = doorway_error(scene, AVATAR, facade, door=DOOR, **setting.options).error
            if math.isinf(row.doorway_mm):
                row.note = "the figure cannot stand in the door"
        found = leak(scene, places, **setting.options)
        row.leak_p50_mm, row.leak_p99_mm, row.leak_worst_mm = found.p50, found.p99, found.worst
        row.leak_share = found.passed
        tick()
    default = next(s.row for s in settings if s.row.knob == TOLERANCE and s.row.default)
    for setting in settings:
        if setting.row.knob in ALIKE:
            row = setting.row
            row.doorway_mm, row.leak_share = default.doorway_mm, default.leak_share
            row.leak_p50_mm, row.leak_p99_mm, row.leak_worst_mm = (
                default.leak_p50_mm, default.leak_p99_mm, default.leak_worst_mm,
            )  # fmt: skip


def measure_made(settings: list[Setting], folder: Path, plan: Plan, tick: Callable[[], None]) -> None:
    """Fill in the doorway errors measured on generated doors, for the plan's models.

    The other doorway error, of doorway.py, is inferred from one wide door.
    folder: an empty folder for the façades.  tick: called after each façade.
    """
    own = {s.row.setting: s for s in settings if s.row.knob == RADIUS and s.row.setting in plan.made_models}
    if not own:
        return
    config = next(iter(own.values())).config
    found = made_doorways(folder, config, list(own), points=plan.points, seed=SEED, tick=tick)
    for model, doorway in found.items():
        own[model].row.made_doorway_mm = doorway.error
