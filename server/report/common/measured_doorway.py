"""Doorway error measured directly, on generated façades with doors of decreasing width.

doorway.py infers the same error from one wide door. The two differ where a narrow door is scanned
differently. The scanner stations do not move, and see the jambs of a narrow door at a smaller angle
and therefore with fewer points. A ray that grazes the near edge of one jamb and continues to the
other gives a mixed return in the middle of the passage: zero to five such points were found in
doors of 0.59 to 0.61 m scanned with two seeds. Such a point stops the figure whatever its radius:
with the generated façade's usual seed all radius models give 87 mm, and requiring two of three
scans to agree gives 86 mm.
"""

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ....builder.config import BuildConfig
from ....builder.pipeline import build_archive
from ....builder.synthetic.facade import NARROWEST_DOOR
from ....builder.synthetic.scenes import make_facade
from ....builder.synthetic.truth import FacadeTruth, read_truth
from ....schemas.wire.answers import Verdict
from ...scene import Scene
from .doorway import SOLE_HEIGHTS, Doorway, made_figure, passage

# Widest door tried [m], twice the figure. If the figure does not pass it, the error is infinite.
WIDEST = 1.06
# Resolution of the door's width, half a millimetre [m].
FINEST = 0.0005
AVATAR = "figure"


class GeneratedDoor(NamedTuple):
    """A generated façade: its scene, with the figure added, and its ground truth."""

    scene: Scene
    truth: FacadeTruth


def measure_doorways(
    folder: Path,
    config: BuildConfig,
    models: Sequence[str],
    *,
    points: int = 587_923,
    seed: int = 2012,
    tick: Callable[[], None] = lambda: None,
) -> dict[str, Doorway]:
    """Return, for each radius model, the narrowest generated main door that the figure passes.

    The figure moves along the middle. The width is found by bisection between 0.5 m and WIDEST,
    which takes about 12 façades for the first model. Façades are reused for the other models.
    folder: an empty folder for scans and archives.  config: of the builds; must store the radius
    models.
    points, seed: of the façades.  tick: called after each façade.
    """
    made: dict[float, GeneratedDoor] = {}
    figure = made_figure()
    with ExitStack() as scenes:

        def at(width: float) -> GeneratedDoor:
            """Return the façade with a door of this width, generated at the first call."""
            if width not in made:
                made[width] = _make(folder / f"door{len(made)}", config, width, points, seed)
                scenes.callback(made[width].scene.close)
                tick()
            return made[width]

        def passing(model: str, width: float) -> bool:
            """Return whether the figure passes a door of this width under this model."""
            return passes(at(width), model)

        own = float(np.ptp(figure[:, 0])) + 2 * (at(WIDEST).scene.add_avatar(AVATAR, figure).radius or 0.0)
        found = {}
        for model in models:
            narrowest = _narrowest(partial(passing, model))
            found[model] = Doorway(narrowest, own, (narrowest - own) * 1000)
    return found


def passes(door: GeneratedDoor, model: str) -> bool:
    """Return whether the figure passes the main door at half of the heights SOLE_HEIGHTS or more."""
    figure = made_figure()
    clear = 0
    for lift in SOLE_HEIGHTS:
        poses = passage(door.truth.door("main"), lift, door.truth.origin, figure)
        verdict = door.scene.collide(AVATAR, poses, radius_model=model).verdict
        clear += bool((verdict == Verdict.CLEAR).all())
    return 2 * clear >= len(SOLE_HEIGHTS)


def _narrowest(passing: Callable[[float], bool]) -> float:
    """Return the least passing width [m], within FINEST; infinite if WIDEST fails."""
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


def _make(folder: Path, config: BuildConfig, width: float, points: int, seed: int) -> GeneratedDoor:
    """Generate, build and open a façade in `folder`."""
    folder.mkdir(parents=True)
    made = make_facade(folder / "facade.laz", points=points, seed=seed, door=width)
    build_archive(list(made.paths), folder / "archive", config)
    scene = Scene.open(folder / "archive")
    scene.add_avatar(AVATAR, made_figure())
    return GeneratedDoor(scene, read_truth(made.truth).facades[0])
