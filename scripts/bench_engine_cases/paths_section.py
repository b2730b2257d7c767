"""Section `paths`: thousands of poses in one request, in this process with two threads, and over zenoh."""

import time
from collections.abc import Callable, Iterable
from pathlib import Path

import numpy as np
from measurement.query_poses import Floats, jittered, walk_at
from solidcloud.schemas.wire.answers import Part as Answers
from solidcloud.server.client import Client
from solidcloud.server.report.common.bench_results import Part
from solidcloud.server.report.common.machine import Clock, cores, say
from solidcloud.server.report.walk.server_process import served
from solidcloud.server.scene import Scene

from .bench_context import Bench, our_name

THREADS = 2
RATE = 600.0  # frames per second of the walk: 24,000 poses make start and end of a request negligible
IN_PROCESS, OVER_ZENOH = 100_000.0, 50_000.0
CASE = "walk at 600 frames/s"

Walk = Callable[[Floats], Iterable[Answers]]


def run(bench: Bench, clock: Clock) -> Part:
    """Time both, for each voxel size, on all cores."""
    part = Part("paths")
    poses = walk_at(bench.truth, RATE)
    with cores(None) as count:
        part.remarks.append(f"{count} cores for this section; over zenoh, client and server share them")
        if count < THREADS:
            part.missing.append(f"{THREADS} threads on {count} core: no fair figure")
        for voxel, archive in bench.archives.items():
            _in_process(bench, clock, part, our_name(voxel), archive, poses)
            _over_zenoh(bench, clock, part, our_name(voxel), archive, poses)
    return part


def _time(
    bench: Bench,
    clock: Clock,
    part: Part,
    name: str,
    what: str,
    poses: Floats,
    walk: Walk,
    expected: np.ndarray,
) -> float:
    """Measure poses per second, with all answers received."""
    verdicts = np.concatenate([answers.verdict for answers in walk(poses)])
    if not np.array_equal(verdicts, expected):
        part.wrong.append(f"{name}, {what}: verdicts are not those of collide")
    rates = []
    for _ in clock.loops(bench.loops, 0.2):
        asked = jittered(poses, bench.rng)
        begin = time.perf_counter()
        for _answers in walk(asked):
            pass
        rates.append(len(poses) / (time.perf_counter() - begin))
    return part.add(f"{CASE}, {name}", name, what, rates, "poses/s", len(poses))


def _in_process(bench: Bench, clock: Clock, part: Part, name: str, archive: Path, poses: Floats) -> None:
    with Scene.open(archive) as scene:  # a separate scene, whose threads may use all cores
        scene.add_avatar("avatar", bench.avatar)
        expected = scene.collide("avatar", poses).verdict
        for threads in (1, THREADS):
            rate = _time(
                bench, clock, part, name, f"path, {threads} thread{'s' * (threads > 1)}", poses,
                lambda p, threads=threads: scene.path("avatar", p, threads=threads), expected,
            )  # fmt: skip
    part.goal(
        "path", f"path in process, {THREADS} threads ({name})", rate, IN_PROCESS, "poses/s", at_least=True
    )


def _over_zenoh(bench: Bench, clock: Clock, part: Part, name: str, archive: Path, poses: Floats) -> None:
    text = f"path over zenoh ({name})"
    rate = None
    if not hasattr(Client, "path"):
        part.missing.append(f"{text}: Client.path is not there yet")
    else:
        say(f"starting a server of {archive.name}")
        with served(archive, "bench") as endpoint, Client(endpoint, scene="bench", timeout=30.0) as client:
            client.add_avatar("avatar", bench.avatar)
            expected = client.collide("avatar", poses).verdict
            rate = _time(
                bench,
                clock,
                part,
                name,
                "path over zenoh",
                poses,
                lambda p: client.path("avatar", p),
                expected,
            )
    part.goal("path zenoh", text, rate, OVER_ZENOH, "poses/s", at_least=True)
