"""A voxel in the arena: the points are all there, and bounds only ever grow on the way."""

from fractions import Fraction
from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from served_nodes import row_encloses
from solidcloud.builder.voxel.record_points import voxel_points
from solidcloud.schemas.archive.archive import Archive
from solidcloud.server.kernels.core.scene_arrays import (
    BLOCK_WORDS,
    COUNT,
    FIRST,
    LANES,
    ROW_WORDS,
    resident_bytes,
    scan_run,
)
from solidcloud.server.residency.arena import ArenaBuffer
from solidcloud.server.residency.voxel_store import VoxelStore

pytestmark = pytest.mark.interpreted


@pytest.mark.parametrize(
    ("kind", "voxel", "resolution", "options"),
    [
        ("noise", 4.0, 1e-3, {"cell_points": 16, "leaf": 5, "degree": 3}),
        ("plane", 2.0, 1e-6, {"cell_points": 64}),  # 2 * 10^6 steps: the top BSH has a unit above a step
        ("noise", 1.0, 1e-3, {"leaf": 7, "keep": frozenset({"scan"})}),
        ("duplicates", 0.5, 1e-3, {"with_slab": False, "leaf": 1}),
    ],
)
def test_the_arena_holds_what_the_archive_does(
    tmp_path: Path, kind: str, voxel: float, resolution: float, options: dict
) -> None:
    case = archive_cases.build(
        tmp_path, synthetic_scans.make_scan(kind, 7, 120), voxel=voxel, resolution=resolution, **options
    )
    store = VoxelStore(case.archive)
    buffer = ArenaBuffer(int(store.sizes.max()) + 128)
    with Archive(case.archive) as archive:
        for row in range(len(archive.voxels)):
            for view in buffer.arena:
                view[:] = 0
            data, links = archive.read_voxel(row)
            rows, blocks, lanes = store.load(row, buffer.arena, 64).tolist()
            n, leaves = len(links.first), int(links.is_leaf.sum())
            kept = data.scan_index is not None
            assert store.sizes[row] == resident_bytes(n, leaves, with_scan=kept)
            scans_at = scan_run(np.array([[rows, blocks, lanes]]), 0, BLOCK_WORDS)
            assert store.sizes[row] == 2 * scans_at - 64 + 2 * LANES * leaves * kept
            # Rows, blocks and lanes follow each other from byte 64 on, and nothing is written behind them.
            assert (rows * 4, blocks - rows, lanes - 2 * blocks) == (
                64,
                n * ROW_WORDS,
                2 * leaves * BLOCK_WORDS,
            )
            assert not buffer.arena.halves[32 + store.sizes[row] // 2 :].any()
            points = voxel_points(data, links)
            block = 0
            for i in range(n):
                word = buffer.arena.words[rows + i * ROW_WORDS :][:ROW_WORDS].astype(np.float64)
                ints = buffer.arena.ints[rows + i * ROW_WORDS :][:ROW_WORDS]
                assert ints[COUNT] == data.nodes.count[i]
                if links.is_leaf[i]:
                    assert ints[FIRST] == ~block
                    corner = buffer.arena.ints[blocks + block * BLOCK_WORDS :][:BLOCK_WORDS]
                    held = buffer.arena.halves[lanes + block * 3 * LANES :][: 3 * LANES].reshape(3, LANES).T
                    own = points[links.first[i] : links.first[i] + data.nodes.count[i]]
                    assert corner[3] == len(own)
                    assert (held[: len(own)] + corner[:3] == own).all()
                    assert (held[len(own) :] == held[len(own) - 1]).all()
                    if kept:
                        scan = buffer.arena.halves[scans_at + block * LANES :][:LANES]
                        from_scan = data.scan_index[links.first[i] :][: len(own)]
                        assert (scan[: len(own)] == from_scan).all() and (
                            scan[len(own) :] == from_scan[-1]
                        ).all()
                    block += 1
                else:
                    assert ints[FIRST] == links.first[i]
                    own = points[_points_below(i, links, data.nodes.count)]
                assert all(
                    row_encloses(list(map(Fraction, word[:10])), list(map(Fraction, point)))
                    for point in own.tolist()
                )
                assert word[7] == -1.0 or word[7] >= np.linalg.norm(word[4:7])
    store.close()


def _points_below(node: int, links: object, count: np.ndarray) -> list[int]:
    """The points below a node, found by walking down to the leaf nodes."""
    first, is_leaf = links.first, links.is_leaf  # type: ignore[attr-defined]
    if is_leaf[node]:
        return list(range(first[node], first[node] + count[node]))
    return [p for i in range(first[node], first[node] + count[node]) for p in _points_below(i, links, count)]


def test_a_node_without_a_normal_is_cut_by_no_slab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever its record holds there: a forged one cut off points, and contacts were clear."""
    case = archive_cases.build(
        tmp_path, synthetic_scans.make_scan("duplicates", 7, 120), voxel=0.5, resolution=1e-3, with_slab=False
    )
    store = VoxelStore(case.archive)
    buffer = ArenaBuffer(int(store.sizes.max()) + 128)
    opened = Archive.open_voxel

    def forged(archive: Archive, *arguments):
        record = opened(archive, *arguments)
        record.nodes.slab[:] = 7
        return record

    monkeypatch.setattr(Archive, "open_voxel", forged)
    rows, _, _ = store.load(0, buffer.arena, 64).tolist()
    assert not buffer.arena.words[rows + 4 : rows + 7].any(), "it has no normal"
    least, most = buffer.arena.words[rows + 8 : rows + 10]
    assert least <= 0.0 <= most
