"""Sections of bench_effects: effects alone and combined, many users, and undeclared effects."""

import statistics
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import numpy as np
from solidcloud.schemas.scene.effect_table import Crowd, effect_name
from solidcloud.server.archives.masked_store import MaskedStore
from solidcloud.server.report.common.bench_results import Part
from solidcloud.server.report.common.machine import Clock
from solidcloud.server.residency.voxel_store import VoxelStore
from solidcloud.server.scene import Scene

from .effect_costs import ALONE, ARCH, EVERYTHING, WALKING, Stage

FRAME_GOAL, WORST_GOAL, USERS, USERS_GOAL, UNDECLARED_GOAL = 60.0, 1000.0, 30, 5.0, 1.02
NOTES = {
    "frame": "stop, sweep, slide, step and ground on the walk of 1,200 frames, mean; the median frame beside it",
    "users": "30 users on the same walk, 40 frames apart, one after the other in one thread",
    "undeclared": "the same scene in two processes in turn: one that never imported another effect, and one where a "
    "scene with all effects is open, too; the middle of the turns' ratios",
}
TURNS = 15


def _name(effects: tuple) -> str:
    return ", ".join(effect_name(effect) for effect in effects) or "nothing"


def walk(stage: Stage, clock: Clock, loops: int) -> tuple[Part, dict[str, np.ndarray]]:
    """Time each set of effects in turn; for all together, also each effect in each frame."""
    part = Part("walk")
    sets = {_name(e): e for e in ((), *ALONE.values(), EVERYTHING)}
    means: dict[str, list[float]] = {name: [] for name in sets}
    medians: dict[str, list[float]] = {name: [] for name in sets}
    worst: dict[str, list[float]] = {name: [] for name in sets}
    stacked: list[dict[str, np.ndarray]] = []
    for effects in sets.values():
        stage.walk(effects)
    for _ in clock.loops(loops):
        for name, effects in sets.items():
            found = stage.walk(effects)
            means[name].append(1e6 * found.frames.mean())
            medians[name].append(1e6 * float(np.median(found.frames)))
            worst[name].append(1e6 * float(np.percentile(found.frames, 99)))
        stacked.append(stage.walk(EVERYTHING).effects)
        clock.look_around()
    count = len(stage.poses)
    for name in sets:
        part.add(name, "frame", "mean", means[name], "us", count)
        part.add(name, "frame", "median", medians[name], "us", count)
        part.add(name, "frame", "p99", worst[name], "us", count)
    company = {name: np.median([each[name] for each in stacked], axis=0) for name in stacked[0]}
    for name, effects in ALONE.items():
        own = [1e6 * stage.walk(effects).effects[name].mean() for _ in range(min(loops, 3))]
        beside = _name(tuple(effect for effect in effects if effect_name(effect) != name))
        part.add("an effect", name, f"own time, alone beside {beside}", own, "us", count)
        if name in company:
            part.add(
                "an effect", name, "own time, in company of all", 1e6 * company[name].mean(), "us", count
            )
    part.goal(
        "frame",
        f"{_name(WALKING)}: mean frame",
        part.value(_name(WALKING), "frame", "mean"),
        FRAME_GOAL,
        "us",
    )
    part.goal("frame", f"{_name(WALKING)}: p99", part.value(_name(WALKING), "frame", "p99"), WORST_GOAL, "us")
    part.remarks.append(f"of {count} frames, {_counts(stage)}")
    return part, company


def _counts(stage: Stage) -> str:
    """Return the work counts of a frame."""
    found = stage.walk(WALKING)
    far = np.linalg.norm(found.places[:, :2] - stage.poses[:, :2, 3], axis=1)
    return (
        f"{found.visits / len(found.frames):.0f} node visits each; the body is {1e3 * np.median(far):.1f} mm from its "
        f"wish in the middle, {1e3 * far.max():.0f} mm at most"
    )


def users(stage: Stage, clock: Clock, loops: int) -> Part:
    """Time many users in one frame; with `crowd` they jam at the door, which the walk passes both ways."""
    part = Part("users")
    for effects in (WALKING, (*WALKING, Crowd())):
        stage.crowd(effects, USERS)
        mean, worst = [], []
        for _ in clock.loops(loops, 0.5):
            took = 1e3 * stage.crowd(effects, USERS)
            mean.append(took.mean())
            worst.append(np.percentile(took, 99))
        name = f"{USERS} users, {_name(effects)}"
        value = part.add(name, "frame of all", "mean", mean, "ms", USERS)
        part.add(name, "frame of all", "p99", worst, "ms", USERS)
        part.goal("users", name, value, USERS_GOAL, "ms")
        clock.look_around()
    return part


def through(archive: Path, loops: int) -> Part:
    """Time opening a scene with a box and without; afterwards the scenes differ only in their points."""
    part = Part("through")
    took: dict[str, list[float]] = {"without": [], "with a box": []}
    masked = partial(MaskedStore, boxes=[(box.low, box.high) for box in ARCH.boxes])
    for _ in range(loops):
        for name, values in took.items():
            begin = time.perf_counter()
            with Scene.open(archive, open_store=masked if name == "with a box" else VoxelStore):
                values.append(1e3 * (time.perf_counter() - begin))
    for name, values in took.items():
        part.add("opening the scene", name, "time", values, "ms")
    return part


class Child:
    """Process that walks on command and reports the mean duration of a frame [us]."""

    def __init__(self, script: Path, archive: Path, everything: bool) -> None:
        options = ["--child", str(archive), "everything" if everything else "alone"]
        self._process = subprocess.Popen(
            [sys.executable, str(script), *options], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def turn(self) -> float:
        """Run one walk; return its mean frame [us]."""
        assert self._process.stdin is not None and self._process.stdout is not None
        print("walk", file=self._process.stdin, flush=True)
        return float(self._process.stdout.readline())

    def close(self) -> None:
        """End the process."""
        self._process.communicate()


def undeclared(script: Path, archive: Path, clock: Clock) -> Part:
    """Time the same scene with all undeclared effects loaded, and without; alternating."""
    part = Part("undeclared")
    children = [Child(script, archive, everything) for everything in (False, True)]
    try:
        for child in children:
            child.turn()
        ratios, times = [], ([], [])
        for number in range(TURNS):
            found = [0.0, 0.0]
            for which in (0, 1) if number % 2 else (1, 0):
                found[which] = children[which].turn()
                times[which].append(found[which])
            ratios.append(found[1] / found[0])
            clock.look_around()
    finally:
        for child in children:
            child.close()
    part.add(_name(WALKING), "nothing else imported", "median frame", times[0], "us")
    part.add(_name(WALKING), "all effects imported, and a scene of them open", "median frame", times[1], "us")
    middle = part.add(_name(WALKING), "the latter / the former", "ratio", ratios, "x")
    part.goal("undeclared", "effects not declared: frame / frame without them", middle, UNDECLARED_GOAL, "x")
    part.remarks.append(
        f"ratios of {TURNS} turns: {min(ratios):.3f} to {max(ratios):.3f}, "
        f"middle half {np.percentile(ratios, 25):.3f} to {np.percentile(ratios, 75):.3f}"
    )
    return part


def child(archive: Path, everything: bool, stage: Stage) -> None:
    """Run the child process: one walk for each line it reads."""
    other = Stage(archive, stage.avatar, stage.poses) if everything else None
    if other is not None:
        other.walk(EVERYTHING)
    stage.walk(WALKING)
    for _ in sys.stdin:
        print(statistics.median((1e6 * stage.walk(WALKING).frames).tolist()), flush=True)
    if other is not None:
        other.scene.close()
