"""Section `memory`: resident bytes per point, and the time to load a voxel's record."""

import time

import numpy as np
from measurement.measured_archives import PAPER_VOXEL, archive_bytes
from solidcloud.server.report.common.bench_results import Part
from solidcloud.server.report.common.machine import Clock
from solidcloud.server.residency.arena import ArenaBuffer
from solidcloud.server.residency.voxel_store import VoxelStore

from .bench_context import Bench, our_name

BYTES_A_POINT, DECODE_MS = 10.0, 5.0
MAX_LOADS = 40


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
    return part


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
