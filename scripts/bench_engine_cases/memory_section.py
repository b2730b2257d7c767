"""Section `memory`: resident bytes per point, time to load a voxel's record, voxels that the walk loads."""

import time
from collections.abc import Callable

import numpy as np
from measurement.measured_archives import PAPER_VOXEL, archive_bytes, build
from solidcloud.builder.synthetic.scenes import make_facade
from solidcloud.server.report.common.bench_results import Part
from solidcloud.server.report.common.machine import Clock
from solidcloud.server.residency.arena import ArenaBuffer
from solidcloud.server.residency.voxel_store import VoxelStore
from solidcloud.server.scene import Scene

from .bench_context import Bench, our_name

BYTES_A_POINT, DECODE_MS = 10.0, 5.0
MAX_LOADS = 40
SMALL_VOXEL = 2  # [m]; smaller than what a query reaches, so that the broad phase decides what is loaded
MOST_LOADED = {"collide": 51, "distance": 125, "raycast": 267}
DISTANCE_REACH, RAY_REACH = 2.0, 50.0  # [m]


def run(bench: Bench, clock: Clock) -> Part:
    """Count and time, for each voxel size."""
    part = Part("memory")
    for voxel, path in bench.archives.items():
        name = our_name(voxel)
        store = VoxelStore(path)
        try:
            points = store.archive.header.points
            resident = part.add("façade", name, "resident", store.sizes.sum() / points, "bytes/point", points)
            part.add("façade", name, "archive's files", archive_bytes(path) / points, "bytes/point", points)
            part.goal("resident", f"resident memory ({name})", resident, BYTES_A_POINT, "bytes/point")
            loads = _loads(bench, clock, part, store, name)
        finally:
            store.close()
        if voxel == PAPER_VOXEL:
            part.goal("decode", f"the paper's voxel, its record to resident ({name})", loads, DECODE_MS, "ms")
    _walk_loads(bench, part)
    return part


def _walk_loads(bench: Bench, part: Part) -> None:
    """Count the voxels that each query loads along the walk, beginning with nothing in memory."""
    scan = bench.folder / "small_voxels.laz"
    make_facade(scan)
    archive = build(scan, bench.folder / "small_voxels", voxel=SMALL_VOXEL, step=None)
    name, walk = our_name(SMALL_VOXEL), bench.walk
    eyes, directions = walk[:, :3, 3] + [0.0, 0.0, 1.5], np.random.default_rng(7).normal(size=(len(walk), 3))
    asked: dict[str, Callable[[Scene], object]] = {
        "collide": lambda scene: scene.collide("avatar", walk),
        "distance": lambda scene: scene.distance("avatar", walk, DISTANCE_REACH),
        "raycast": lambda scene: scene.raycast(eyes, directions, RAY_REACH),
    }
    for query, ask in asked.items():
        with Scene.open(archive, budget_bytes=1 << 30) as scene:
            scene.add_avatar("avatar", bench.avatar)
            ask(scene)
            found = scene.stats()
        part.add("walk", name, f"{query}, resident bytes", found.resident_bytes, "bytes", len(walk))
        loads = part.add("walk", name, f"{query}, voxels loaded", found.misses, "voxels", len(walk))
        part.goal(
            f"{query} loads", f"voxels that {query} loads along the walk", loads, MOST_LOADED[query], "voxels"
        )


def _loads(bench: Bench, clock: Clock, part: Part, store: VoxelStore, name: str) -> float:
    """Time loading the largest voxel [ms], from its record's bytes, with the file in the page cache."""
    row = int(np.argmax(store.sizes))
    arena = ArenaBuffer(ArenaBuffer.rounded(int(store.sizes[row]))).arena
    read, decoded, whole = [], [], []
    store.load(row, arena, 0)
    for _ in clock.loops(max(bench.loops, MAX_LOADS), 0.4):
        begin = time.perf_counter()
        store.archive.read_frames(row)
        middle = time.perf_counter()
        store.archive.read_voxel(row)
        after = time.perf_counter()
        store.load(row, arena, 0)
        end = time.perf_counter()
        read.append((middle - begin) * 1e3)
        decoded.append((after - middle) * 1e3)
        whole.append((end - after) * 1e3)
    count = int(store.archive.voxels["points"][row]) if "points" in store.archive.voxels.dtype.names else None
    case = f"largest voxel, {name}"
    part.add(case, name, "read its frames", read, "ms", count)
    part.add(case, name, "read, decode, check", decoded, "ms", count)
    whole_ms = part.add(case, name, "read, decode, check, lay out", whole, "ms", count)
    part.remarks.append(f"{case}: the goal counts from the record's bytes on: all but `read its frames`")
    return part.add(case, name, "record to resident", whole_ms - float(np.median(read)), "ms", count)
