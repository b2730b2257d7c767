"""The two errors a user feels, of every setting that can change them: too narrow a doorway, and walls that leak."""

import math
from collections.abc import Callable
from pathlib import Path

from .accuracy_case import AVATAR, SEED, Ground
from .accuracy_engine import Archives, Setting
from .accuracy_plan import Plan
from .accuracy_row import BUDGET, DEGREE, LEAF, NODES, RADIUS, STEP, TOLERANCE
from .doorway import doorway_error
from .leak import leak, leak_places
from .made_doorway import made_doorways

# Knobs that change no answer: what is felt is what is felt by default.
ALIKE = (DEGREE, LEAF, NODES)
FELT = (TOLERANCE, BUDGET, STEP, RADIUS)
DOOR = "main"
# How many façades `measure_made` makes, about: twelve for the first model, and a few for each of three others.
FACADES = 20


def measure_felt(
    settings: list[Setting], archives: Archives, ground: Ground, plan: Plan, tick: Callable[[], None]
) -> None:
    """Fill in the doorway and the leak of each setting; nothing where the ground's truth is not known.

    The doorway is that of the made figure: with another avatar the leak alone is measured, whose ball is its own.
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
    """Fill in the doorway found by making doors, of the plan's models; doorway.py infers it from one wide door.

    folder: an empty one, for the façades.  tick: called after each façade.
    """
    own = {s.row.setting: s for s in settings if s.row.knob == RADIUS and s.row.setting in plan.made_models}
    if not own:
        return
    config = next(iter(own.values())).config
    found = made_doorways(folder, config, list(own), points=plan.points, seed=SEED, tick=tick)
    for model, doorway in found.items():
        own[model].row.made_doorway_mm = doorway.error
