"""The narrowest door made: façades are made with narrower and narrower doors, scanned, built, and walked through.

The long way to what doorway.py infers from one wide door. The two differ where a narrow door is scanned otherwise than
a wide one. The stations stand where they stand, and see its jambs at a smaller angle, so more sparsely. And where a
ray grazes the near edge of one jamb and goes on to the other, the mixed return hangs in the middle of the passage: in
doors of 0.59 to 0.61 m, scanned with two seeds, none to five points did. Such a point stops the figure whatever its
radius: with the made façade's usual seed all radius models say 87 mm, and two of three scans agreeing 86 mm.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ...builder.config import BuildConfig
from ...builder.made.facade import NARROWEST_DOOR
from ...builder.made.scenes import make_facade
from ...builder.made.truth import FacadeTruth, read_truth
from ...builder.pipeline import build_archive
from ...schemas.answers import Verdict
from ..scene import Scene
from .doorway import LIFTS, Doorway, made_figure, passage

# The widest door tried [m], twice the figure: one that does not pass there needs an infinite one.
WIDEST = 1.06
# Doors are told apart by half a millimetre [m].
FINEST = 0.0005
AVATAR = "figure"


class MadeDoor(NamedTuple):
    """A façade made with a door of some width: its scene, with the figure, and its truth."""

    scene: Scene
    truth: FacadeTruth


def made_doorways(
    folder: Path,
    config: BuildConfig,
    models: Sequence[str],
    *,
    points: int = 587_923,
    seed: int = 2012,
    tick: Callable[[], None] = lambda: None,
) -> dict[str, Doorway]:
    """The narrowest made main door that the figure passes along the middle, under each of the radius models.

    folder: an empty one, for scans and archives.  config: of the builds; stores what `models` need.  points, seed: of
    the façades.  tick: called after each façade. A door is found by bisection between 0.5 m and WIDEST, about 12
    façades for the first model; what was made for one serves all.
    """
    made: dict[float, MadeDoor] = {}
    figure = made_figure()
    with ExitStack() as scenes:

        def at(width: float) -> MadeDoor:
            """The façade with a door of this width, made when first asked for."""
            if width not in made:
                made[width] = _make(folder / f"door{len(made)}", config, width, points, seed)
                scenes.callback(made[width].scene.close)
                tick()
            return made[width]

        def passing(model: str, width: float) -> bool:
            """Whether the figure passes a door of this width under this model."""
            return passes(at(width), model)

        own = float(np.ptp(figure[:, 0])) + 2 * (at(WIDEST).scene.add_avatar(AVATAR, figure).radius or 0.0)
        found = {}
        for model in models:
            narrowest = _narrowest(partial(passing, model))
            found[model] = Doorway(narrowest, own, (narrowest - own) * 1000)
    return found


def passes(door: MadeDoor, model: str) -> bool:
    """Whether the figure goes clear through the middle of the main door, at half of the heights LIFTS or more."""
    figure = made_figure()
    clear = 0
    for lift in LIFTS:
        poses = passage(door.truth.door("main"), lift, door.truth.origin, figure)
        verdict = door.scene.collide(AVATAR, poses, radius_model=model).verdict
        clear += bool((verdict == Verdict.CLEAR).all())
    return 2 * clear >= len(LIFTS)


def _narrowest(passing: Callable[[float], bool]) -> float:
    """The least width [m] found passing, within FINEST of one that does not; infinite if WIDEST does not."""
    if not passing(WIDEST):
        return math.inf
    blocked, passed = NARROWEST_DOOR, WIDEST
    while passed - blocked > FINEST:
        width = (blocked + passed) / 2
        if passing(width):
            passed = width
        else:
            blocked = width
    return passed


def _make(folder: Path, config: BuildConfig, width: float, points: int, seed: int) -> MadeDoor:
    """Make, build and open a façade; everything is put into `folder`."""
    folder.mkdir(parents=True)
    made = make_facade(folder / "facade.laz", points=points, seed=seed, door=width)
    build_archive(list(made.paths), folder / "archive", config)
    scene = Scene.open(folder / "archive")
    scene.add_avatar(AVATAR, made_figure())
    return MadeDoor(scene, read_truth(made.truth).facades[0])
