"""Observed builds of generated façades with the real command: times, memory, bytes per point."""

import itertools
import shutil
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from solidcloud.server.report.common.machine import say

from .build_watch import Sample, Watched, last_json, watch

COMMAND = [sys.executable, "-m", "solidcloud.server.cli.main"]
# Time of a build outside its stages: the interpreter, kernels from numba's cache, processes,
# renaming.
REST = "start, rest"


@dataclass(frozen=True)
class Built:
    """One build.

    summary: the command's own report.
    watched: its resources, observed from outside.
    step: of its lattice [m].
    stored, preview: bytes of index and shards, and of the files beside them.
    """

    points: int
    summary: dict[str, Any]
    watched: Watched
    step: float
    stored: int
    preview: int

    @property
    def seconds(self) -> float:
        """Return the wall time from the command's start to its end."""
        return self.watched.seconds

    @property
    def bytes_a_point(self) -> float:
        """Return bytes per point of the archive: index and shards."""
        return self.stored / self.points

    @property
    def stages(self) -> dict[str, float]:
        """Return the seconds of each stage, and of the time outside all stages."""
        named = {name: float(seconds) for name, seconds in self.summary["stages"].items()}
        return {**named, REST: max(0.0, self.seconds - sum(named.values()))}


class BuildError(RuntimeError):
    """Failure of the command."""


def scan_path(work: Path, points: int) -> Path:
    """Return the path of the façade of this many points."""
    return work / f"facade-{points}.las"


def made_scan(work: Path, points: int) -> Path:
    """Return the generated façade of this many points as LAS; generate it where it is missing."""
    path = scan_path(work, points)
    if not path.exists():
        say(f"making a façade of {points:,} points, once")
        work.mkdir(parents=True, exist_ok=True)
        _must([*COMMAND, "make", "facade", "-o", str(path), "--points", str(points)])
    return path


def build(
    scan: Path,
    target: Path,
    *,
    memory: str,
    jobs: int,
    voxel: float | None = None,
    step: float | None = None,
    extra: Iterable[str] = (),
) -> Built:
    """Build an archive under observation. Raises BuildError with the command's output."""
    shutil.rmtree(target, ignore_errors=True)
    # An interrupted benchmark may have left a partial build: resuming it would take less time.
    options = ["--memory", memory, "--jobs", str(jobs), "--json", "--fresh", *extra]
    options += ["--voxel", f"{voxel:g}"] if voxel else []
    options += ["--resolution", f"{step:g}"] if step else []
    watched = _must([*COMMAND, "build", str(scan), "-o", str(target), *options])
    summary = last_json(watched.out)
    sizes = {path: path.stat().st_size for path in target.rglob("*") if path.is_file()}
    stored = sum(size for path, size in sizes.items() if path.suffix == ".h5")
    return Built(
        int(summary["points"]),
        summary,
        watched,
        float(summary["lattice_step"]),
        stored,
        sum(sizes.values()) - stored,
    )


def validate(target: Path) -> int:
    """Return the number of faults that `validate` finds in an archive."""
    return len(last_json(_must([*COMMAND, "validate", str(target), "--json"], (0, 3)).out)["faults"])


def _must(command: list[str], codes: tuple[int, ...] = (0,)) -> Watched:
    watched = watch(command)
    if watched.code not in codes:
        raise BuildError(f"{' '.join(command[2:])}: exit code {watched.code}: {watched.err.strip()[-2000:]}")
    return watched


def stage_peaks(stages: dict[str, float], samples: list[Sample], seconds: float) -> dict[str, int]:
    """Return the maximum memory during each stage [bytes], sum of PSS.

    Stages are assumed to be consecutive and to end with the command; time outside all stages comes
    before them.
    """
    named = {name: spent for name, spent in stages.items() if name != REST}
    ends = list(itertools.accumulate(named.values()))
    start = max(0.0, seconds - (ends[-1] if ends else 0.0))
    peaks = dict.fromkeys(stages, 0)
    for sample in samples:
        into = sample.at - start
        name = (
            REST if into < 0 else next((n for n, end in zip(named, ends, strict=True) if into <= end), REST)
        )
        peaks[name] = max(peaks[name], sample.pss)
    return peaks


def linearity(built: dict[int, list[Built]]) -> dict[tuple[int, int], float]:
    """Return ratios of seconds per point between consecutive sizes.

    (smaller, larger) -> ratio of the medians.
    """
    spent = {points: _median_seconds(runs) / points for points, runs in sorted(built.items())}
    return {(small, large): spent[large] / spent[small] for small, large in itertools.pairwise(spent)}


def marginal(built: dict[int, list[Built]]) -> dict[tuple[int, int], float]:
    """Return the seconds per additional point between consecutive sizes.

    (smaller, larger) -> seconds, from medians. Constant costs, above all the command's start, are
    excluded.
    """
    spent = {points: _median_seconds(runs) for points, runs in sorted(built.items())}
    return {
        (small, large): (spent[large] - spent[small]) / (large - small)
        for small, large in itertools.pairwise(spent)
    }


def _median_seconds(runs: list[Built]) -> float:
    ordered = sorted(run.seconds for run in runs)
    return ordered[len(ordered) // 2]


def median_run(runs: list[Built]) -> Built:
    """Return the run with the median time, the slower of two."""
    return sorted(runs, key=lambda run: run.seconds)[len(runs) // 2]


def report(built: Built) -> dict[str, Any]:
    """Return a build for the JSON, its memory over time included."""
    return {
        "points": built.points,
        "step": built.step,
        "seconds": built.seconds,
        "cpu_seconds": built.watched.cpu,
        "others": built.watched.others,
        "looking": built.watched.looking,
        "stages": built.stages,
        "bytes": built.stored,
        "preview_bytes": built.preview,
        "voxels": built.summary["voxels"],
        "peak_pss": built.watched.peak,
        "peak_anonymous": built.watched.peak_anonymous,
        "stage_peaks": stage_peaks(built.stages, built.watched.samples, built.seconds),
        "memory": [s._asdict() for s in built.watched.samples],
    }
