"""Measurement of the server's engine, for each knob: tolerance, budget, radius model and others."""

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

from .....builder.config import DEFAULT_STEP, BuildConfig
from .....builder.pipeline import build_archive
from .....schemas.errors import InternalError
from .....schemas.wire.answers import Verdict
from ....residency.arena import ArenaBuffer
from ....residency.voxel_store import VoxelStore
from ....scene import Scene
from .interleaved_timing import TimedSetting, take_times
from .measured_scene import AVATAR, REACH, MeasuredScene
from .measurement_plan import MeasurementPlan
from .reference_answers import ReferenceAnswers
from .setting_results import (
    BUDGET,
    DEGREE,
    LEAF,
    NODES,
    RADIUS,
    STEP,
    TOLERANCE,
    Row,
    compare_distances,
    compare_verdicts,
)

Floats = NDArray[np.float64]
Tick = Callable[[], None]

DECODE_LOOPS = 3
# Time to build the archive of a setting, where its comparison takes 1 (measured: 0.6 s and 0.04 s
# with 200,000 points and 800 poses); and the time of a pose apart from its node and pair tests, in
# tests. They are for the estimate of the remaining time only.
BUILD_COST, POSE_COST = 15.0, 60.0


class Setting(NamedTuple):
    """One setting of the engine.

    row: receives the results.  config: of its archive's build.  options: of each query.
    """

    row: Row
    config: BuildConfig
    options: dict[str, Any]


def engine_settings(plan: MeasurementPlan, plain: BuildConfig, radius: float) -> list[Setting]:
    """Return one setting per value of each knob, with defaults for everything else.

    The values include each knob's default.

    plain: the measured scene's configuration, with a lattice step; its values are the defaults.
    radius: result of the model `mean` for `plain` [m]. Other builds use it as a fixed radius. A
    coarser lattice then changes only the lattice, not the mean distance of the points that are
    left.
    """
    found: list[Setting] = []
    step = plain.resolution or DEFAULT_STEP

    def with_radius(default: bool, **changes: Any) -> BuildConfig:
        """Return a build with the default's radius; the default itself is unchanged."""
        return plain if default else replace(plain, radius=radius, **changes)

    def add(
        knob: str, setting: str, config: BuildConfig, default: bool, /, value: float, **options: Any
    ) -> None:
        found.append(Setting(Row(knob, setting, value, default), config, options))

    for tolerance in plan.tolerances:
        options = {"tolerance": tolerance} if tolerance else {}
        name = f"tolerance {length_name(tolerance)}" if tolerance else "0"
        add(TOLERANCE, name, plain, not tolerance, tolerance, **options)
    for budget in plan.budgets:
        add(BUDGET, f"{budget:,} visits", plain, False, budget, budget_visits=budget)
    add(BUDGET, "none", plain, True, math.inf)
    for value in sorted({*plan.steps, step}):
        default = value == step
        add(STEP, length_name(value), with_radius(default, resolution=value), default, value)
    for degree in sorted({*plan.degrees, plain.degree}):
        default = degree == plain.degree
        add(DEGREE, str(degree), with_radius(default, degree=degree), default, degree)
    for leaf in sorted({*plan.leaves, plain.leaf}):
        default = leaf == plain.leaf
        add(LEAF, str(leaf), with_radius(default, leaf=leaf), default, leaf)
    for slab, name in ((True, "sphere with slab"), (False, "sphere")):
        default = slab == plain.with_slab
        add(NODES, name, with_radius(default, with_slab=slab), default, float(slab))
    return found


def radius_settings(plan: MeasurementPlan, plain: BuildConfig, radius: float) -> list[Setting]:
    """Return the settings of the radius models with the plan's factors.

    The radii of `fixed` are rounded.
    """
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
    """Format a length as a label: 0, 2 mm, 5 cm."""
    if not metres:
        return "0"
    return f"{metres * 100:g} cm" if metres >= 0.01 else f"{metres * 1e3:g} mm"


class Archives:
    """Archives of the settings, each built once and kept open; a context manager."""

    def __init__(self, measured: MeasuredScene, folder: Path) -> None:
        """Build archives of the measured scan in `folder` when they are first needed."""
        self._measured, self._folder = measured, folder
        self._scenes: dict[tuple[Any, ...], Scene] = {}
        self._figures: dict[tuple[Any, ...], tuple[int, float]] = {}
        self._folders: dict[tuple[Any, ...], Path] = {}
        self._open = contextlib.ExitStack()

    def __enter__(self) -> "Archives":
        """Return the archives."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close all archives."""
        self._open.close()

    def scene(self, config: BuildConfig) -> Scene:
        """Return the scene built with `config`, with the avatar added.

        Its cache holds the whole archive: answers are timed, not loads.
        """
        key = _key(config)
        if key not in self._scenes:
            target = self._folder / f"archive-{len(self._scenes)}"
            self._folders[key] = target
            # The archive usually has one shard: more processes would only load numba several times.
            summary = build_archive([self._measured.scan], target, replace(config, jobs=1))
            self._figures[key] = (summary.bytes, decode_seconds(target))
            store = VoxelStore(target)
            budget = sum(ArenaBuffer.rounded(int(size)) for size in store.sizes)
            store.close()
            scene = self._open.enter_context(Scene.open(target, budget_bytes=budget))
            scene.add_avatar(AVATAR, self._measured.avatar)
            self._scenes[key] = scene
        return self._scenes[key]

    def figures(self, config: BuildConfig) -> tuple[int, float]:
        """Return the size of an archive's files [bytes] and the time to decode all voxels [s]."""
        self.scene(config)
        return self._figures[_key(config)]

    def folder(self, config: BuildConfig) -> Path:
        """Return the folder of the archive built with `config`."""
        self.scene(config)
        return self._folders[_key(config)]


def _key(config: BuildConfig) -> tuple[Any, ...]:
    """Return a key that identifies the archive of a configuration."""
    return tuple(sorted(config.identity().items()))


def decode_seconds(folder: Path) -> float:
    """Return the least of DECODE_LOOPS times to read, check and lay out all voxels [s]."""
    store = VoxelStore(folder)
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


def compare_engine(
    settings: list[Setting],
    archives: Archives,
    measured: MeasuredScene,
    reference: ReferenceAnswers,
    tick: Tick,
) -> None:
    """Fill in the errors, node and pair tests, and archive size of each setting."""
    for setting in settings:
        row, scene = setting.row, archives.scene(setting.config)
        answers = scene.collide(AVATAR, measured.judged, **setting.options)
        contact, unknown = answers.verdict == Verdict.CONTACT, answers.verdict == Verdict.UNKNOWN
        compare_verdicts(row, contact, unknown, reference.contact)
        row.node_tests, row.pair_tests = float(answers.node_visits.mean()), float(answers.point_tests.mean())
        tangent = scene.collide(AVATAR, reference.tangent_poses, **setting.options).verdict
        compare_verdicts(
            row, tangent == Verdict.CONTACT, tangent == Verdict.UNKNOWN, reference.tangent, tangent=True
        )
        found = scene.distance(AVATAR, measured.judged, REACH, **setting.options)
        compare_distances(row, found.signed_distance, reference.distance)
        row.archive_bytes, seconds = archives.figures(setting.config)
        row.decode_ms = seconds * 1e3
        row.scene = measured.name
        _check_answers(setting)
        tick()


def _check_answers(setting: Setting) -> None:
    """Raise InternalError if a setting changed an answer that it must not change."""
    row = setting.row
    wrong = row.early + row.late + row.unknown + row.tangent_early + row.tangent_late + row.tangent_unknown
    exact = row.knob == TOLERANCE and not setting.options
    if (exact or row.knob in (DEGREE, LEAF, NODES)) and wrong:
        raise InternalError(
            f"{row.knob} {row.setting}: {wrong} verdicts differ from the default's, expected none: this is a bug of "
            "this software, report it"
        )
    if row.knob in (TOLERANCE, BUDGET) and row.late + row.tangent_late:
        raise InternalError(
            f"{row.knob} {row.setting}: {row.late + row.tangent_late} touching poses are called clear, expected "
            "none: this is a bug of this software, report it"
        )


def time_engine(
    settings: list[Setting], archives: Archives, measured: MeasuredScene, plan: MeasurementPlan, tick: Tick
) -> None:
    """Fill in the time of each setting, and its ratio to the time of the default.

    All settings are timed in turn. Settings with the same archive and options are timed once.
    """
    timed: dict[tuple[Any, ...], TimedSetting] = {}
    of: list[TimedSetting] = []
    for setting in settings:
        scene = archives.scene(setting.config)
        key = (_key(setting.config), *sorted(setting.options.items()))
        if key not in timed:
            timed[key] = TimedSetting(partial(scene.collide, AVATAR, **setting.options))
        of.append(timed[key])
    take_times(list(timed.values()), measured.walk, plan.loops, plan.chunk, tick)
    for setting, subject in zip(settings, of, strict=True):
        fill_times(setting.row, subject)
        default = next(
            t for s, t in zip(settings, of, strict=True) if s.row.knob == setting.row.knob and s.row.default
        )
        setting.row.times = subject.mean / default.mean


def compare_costs(settings: list[Setting], built: BuildConfig) -> list[float]:
    """Return the relative time of each setting in `compare_engine`. built: its archive exists."""
    known, found = {_key(built)}, []
    for setting in settings:
        key = _key(setting.config)
        found.append(1.0 if key in known else 1.0 + BUILD_COST)
        known.add(key)
    return found


def time_costs(settings: list[Setting]) -> list[float]:
    """Return the relative time of each setting that `time_engine` times, by the tests of its poses.

    `compare_engine` has counted these.
    """
    rows: dict[tuple[Any, ...], Row] = {}
    for setting in settings:
        rows.setdefault((_key(setting.config), *sorted(setting.options.items())), setting.row)
    return [POSE_COST + (row.node_tests or 0.0) + (row.pair_tests or 0.0) for row in rows.values()]


def fill_times(row: Row, subject: TimedSetting) -> None:
    """Fill in the times of a subject."""
    row.mean_us, row.noise = subject.mean * 1e6, subject.noise
    row.p50_us, row.p99_us = subject.quantile(0.5) * 1e6, subject.quantile(0.99) * 1e6
