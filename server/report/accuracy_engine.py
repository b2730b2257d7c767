"""The knobs of the server's own engine: tolerance, budget, radius model, lattice step, degree, leaf size, slabs."""

import contextlib
import math
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...builder.config import DEFAULT_STEP, BuildConfig
from ...builder.pipeline import build_archive
from ...schemas.answers import Verdict
from ...schemas.errors import InternalError
from ..arena import ArenaBuffer
from ..scene import Scene
from ..store import Store
from .accuracy_case import AVATAR, REACH, Ground
from .accuracy_plan import Plan
from .accuracy_row import (
    ALONE,
    BUDGET,
    DEGREE,
    LEAF,
    NODES,
    RADIUS,
    STEP,
    TOLERANCE,
    Row,
    judge_distances,
    judge_verdicts,
)
from .accuracy_timing import Timed, take_times

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Tick = Callable[[], None]

DECODE_LOOPS = 3
# Never spent: a tolerance alone is answered exactly, a budget asks for the search that may stop within it.
UNSPENT = 1 << 40


class Exact(NamedTuple):
    """What the judge says. contact: (k,) and distance: (k,) [m] of the judged poses; tangent: (t,) contact of the
    near-tangent ones, poses (t, 4, 4)."""

    contact: Bools
    distance: Floats
    tangent: Bools
    tangent_poses: Floats


class Setting(NamedTuple):
    """One setting of the engine. row: to be filled.  config: how its archive is built.  options: of each question."""

    row: Row
    config: BuildConfig
    options: dict[str, Any]


def engine_settings(plan: Plan, plain: BuildConfig, radius: float) -> list[Setting]:
    """One setting a value of a knob, everything else as by default; each knob's default value is among them.

    plain: the ground's own build, whose values are the defaults; its lattice step is given.
    radius: what `mean` gives there [m], held fixed where an archive is built anew: what a coarser lattice changes is
    then the lattice alone, and not the mean distance of the points that are left.
    """
    found: list[Setting] = []
    step = plain.resolution or DEFAULT_STEP

    def held(default: bool, **changes: Any) -> BuildConfig:
        """A build with the default's radius; the default itself has it anyway, and is not built twice."""
        return plain if default else replace(plain, radius=radius, **changes)

    def add(
        knob: str, setting: str, config: BuildConfig, default: bool, /, value: float, **options: Any
    ) -> None:
        found.append(Setting(Row(knob, setting, value, default), config, options))

    for tolerance in plan.tolerances:
        asked = {"tolerance": tolerance, "budget_visits": UNSPENT} if tolerance else {}
        name = f"search within {length_name(tolerance)}" if tolerance else "0"
        add(TOLERANCE, name, plain, not tolerance, tolerance, **asked)
    add(TOLERANCE, f"{length_name(plan.alone)}{ALONE}", plain, False, plan.alone, tolerance=plan.alone)
    for budget in plan.budgets:
        add(BUDGET, f"{budget:,} visits", plain, False, budget, budget_visits=budget)
    add(BUDGET, "none", plain, True, math.inf)
    for value in sorted({*plan.steps, step}):
        default = value == step
        add(STEP, length_name(value), held(default, resolution=value), default, value)
    for degree in sorted({*plan.degrees, plain.degree}):
        default = degree == plain.degree
        add(DEGREE, str(degree), held(default, degree=degree), default, degree)
    for leaf in sorted({*plan.leaves, plain.leaf}):
        default = leaf == plain.leaf
        add(LEAF, str(leaf), held(default, leaf=leaf), default, leaf)
    for slab, name in ((True, "sphere with slab"), (False, "sphere")):
        default = slab == plain.with_slab
        add(NODES, name, held(default, with_slab=slab), default, float(slab))
    return found


def radius_settings(plan: Plan, plain: BuildConfig, radius: float) -> list[Setting]:
    """The radius models, each with the plan's factors; `fixed` with radii rounded to what a user would type."""
    config = replace(plain, models=frozenset({"mean", "local", "border"}))
    found = []
    for model in ("mean", "local", "border", "local+border"):
        for factor in plan.factors:
            name = model if factor == 1.0 else f"{model}:{factor:g}"
            row = Row(RADIUS, name, factor, name == "mean", factor=factor)
            found.append(Setting(row, config, {"radius_model": name}))
    for factor in plan.factors:
        metres = float(f"{radius * factor:.2g}")
        row = Row(RADIUS, f"fixed:{metres:g}", metres, factor=factor)
        found.append(Setting(row, config, {"radius_model": f"fixed:{metres:g}"}))
    return found


def length_name(metres: float) -> str:
    """A length as a label: 0, 2 mm, 5 cm."""
    if not metres:
        return "0"
    return f"{metres * 100:g} cm" if metres >= 0.01 else f"{metres * 1e3:g} mm"


class Archives:
    """The archives that settings need, each built once and open until the end; a context manager."""

    def __init__(self, ground: Ground, folder: Path) -> None:
        """Archives of the ground's scan, in `folder`."""
        self._ground, self._folder = ground, folder
        self._scenes: dict[tuple[Any, ...], Scene] = {}
        self._figures: dict[tuple[Any, ...], tuple[int, float]] = {}
        self._folders: dict[tuple[Any, ...], Path] = {}
        self._open = contextlib.ExitStack()

    def __enter__(self) -> "Archives":
        """The archives."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close them."""
        self._open.close()

    def scene(self, config: BuildConfig) -> Scene:
        """The scene built as `config` says, with the avatar; all of it fits in memory: answers are timed, not loads."""
        key = _key(config)
        if key not in self._scenes:
            target = self._folder / f"archive-{len(self._scenes)}"
            self._folders[key] = target
            # Of one shard as a rule: more processes would each load numba first, for nothing.
            summary = build_archive([self._ground.scan], target, replace(config, jobs=1))
            self._figures[key] = (summary.bytes, decode_seconds(target))
            store = Store(target)
            budget = sum(ArenaBuffer.rounded(int(size)) for size in store.sizes)
            store.close()
            scene = self._open.enter_context(Scene.open(target, budget_bytes=budget))
            scene.add_avatar(AVATAR, self._ground.avatar)
            self._scenes[key] = scene
        return self._scenes[key]

    def figures(self, config: BuildConfig) -> tuple[int, float]:
        """Bytes of the archive's files, and seconds to read and decode all of its voxels."""
        self.scene(config)
        return self._figures[_key(config)]

    def folder(self, config: BuildConfig) -> Path:
        """Where the archive built as `config` says is."""
        self.scene(config)
        return self._folders[_key(config)]


def _key(config: BuildConfig) -> tuple[Any, ...]:
    """What tells archives apart."""
    return tuple(sorted(config.identity().items()))


def decode_seconds(folder: Path) -> float:
    """The time to read, check and lay out all voxels of an archive, the best of DECODE_LOOPS [s]."""
    store = Store(folder)
    try:
        best = math.inf
        for _ in range(DECODE_LOOPS):
            spent = 0.0
            for row, size in enumerate(store.sizes):
                buffer = ArenaBuffer(ArenaBuffer.rounded(int(size)))
                begin = time.perf_counter()
                store.load(row, buffer.arena, 0)
                spent += time.perf_counter() - begin
            best = min(best, spent)
    finally:
        store.close()
    return best


def judge_engine(
    settings: list[Setting], archives: Archives, ground: Ground, exact: Exact, tick: Tick
) -> None:
    """Fill in what each setting gets wrong, what it visits, and what its archive takes."""
    for setting in settings:
        row, scene = setting.row, archives.scene(setting.config)
        answers = scene.collide(AVATAR, ground.judged, **setting.options)
        contact, unknown = answers.verdict == Verdict.CONTACT, answers.verdict == Verdict.UNKNOWN
        judge_verdicts(row, contact, unknown, exact.contact)
        row.node_tests, row.pair_tests = float(answers.node_visits.mean()), float(answers.point_tests.mean())
        tangent = scene.collide(AVATAR, exact.tangent_poses, **setting.options).verdict
        judge_verdicts(
            row, tangent == Verdict.CONTACT, tangent == Verdict.UNKNOWN, exact.tangent, tangent=True
        )
        found = scene.distance(AVATAR, ground.judged, REACH, **setting.options)
        judge_distances(row, found.signed_distance, exact.distance)
        row.archive_bytes, seconds = archives.figures(setting.config)
        row.decode_ms = seconds * 1e3
        row.scene = ground.name
        _must_be_right(setting)
        tick()


def _must_be_right(setting: Setting) -> None:
    """Raise InternalError where a knob changed an answer that it must not change."""
    row = setting.row
    wrong = row.early + row.late + row.unknown + row.tangent_early + row.tangent_late + row.tangent_unknown
    exact = row.knob == TOLERANCE and "budget_visits" not in setting.options
    if (exact or row.knob in (DEGREE, LEAF, NODES)) and wrong:
        raise InternalError(
            f"{row.knob} {row.setting}: {wrong} verdicts differ from the default's, expected none: an error of this "
            "software, report it"
        )
    if row.knob in (TOLERANCE, BUDGET) and row.late + row.tangent_late:
        raise InternalError(
            f"{row.knob} {row.setting}: {row.late + row.tangent_late} poses are called clear that touch, expected "
            "none: an error of this software, report it"
        )


def time_engine(settings: list[Setting], archives: Archives, ground: Ground, plan: Plan, tick: Tick) -> None:
    """Fill in the time of each setting; `times` is over the default's, which is timed in turn with all others.

    Settings that ask the same of the same archive are one, and timed once.
    """
    timed: dict[tuple[Any, ...], Timed] = {}
    of: list[Timed] = []
    for setting in settings:
        scene = archives.scene(setting.config)
        key = (_key(setting.config), *sorted(setting.options.items()))
        if key not in timed:
            timed[key] = Timed(partial(scene.collide, AVATAR, **setting.options))
        of.append(timed[key])
    take_times(list(timed.values()), ground.walk, plan.loops, plan.chunk, tick)
    for setting, subject in zip(settings, of, strict=True):
        fill_times(setting.row, subject)
        default = next(
            t for s, t in zip(settings, of, strict=True) if s.row.knob == setting.row.knob and s.row.default
        )
        setting.row.times = subject.mean / default.mean


def count_timed(settings: list[Setting]) -> int:
    """How many settings `time_engine` times."""
    return len({(_key(s.config), *sorted(s.options.items())) for s in settings})


def fill_times(row: Row, subject: Timed) -> None:
    """The times of a subject into its row."""
    row.mean_us, row.noise = subject.mean * 1e6, subject.noise
    row.p50_us, row.p99_us = subject.percentile(50) * 1e6, subject.percentile(99) * 1e6
