"""Test that rows given in parts become one frame, and that a frame too long for the index is refused."""

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import zstandard
from solidcloud.schemas.archive import zstd_frame
from solidcloud.schemas.archive.zstd_frame import Expansion, RowStream, pack, unpack
from solidcloud.schemas.errors import BadRequestError


@pytest.mark.parametrize("cuts", [[], [1], [300, 301, 999]])
def test_rows_that_come_in_parts_are_one_frame_of_their_byte_planes(
    cuts: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zstd_frame, "STREAM_BYTES", 700)
    rows = np.zeros(1000, [("x", "<u2", (3,)), ("y", "<f4")])
    rows["x"] = np.arange(3000).reshape(1000, 3) % 517
    rows["y"] = np.sqrt(np.arange(1000))
    frames = set()
    for reverse in (False, True):
        stream = RowStream(tmp_path, rows.dtype, len(rows))
        edges = [0, *cuts, len(rows)]
        parts = list(pairwise(edges))
        for a, b in reversed(parts) if reverse else parts:
            stream.put(a, rows[a:b])
        frames.add(bytes(stream.frame()))
    frame = frames.pop()
    assert not frames
    declared = zstandard.get_frame_parameters(frame)
    assert declared.content_size == rows.nbytes and declared.has_checksum
    planes = np.frombuffer(zstandard.ZstdDecompressor().decompress(frame), np.uint8).reshape(10, 1000)
    assert planes.T.tobytes() == rows.tobytes()
    assert not list(tmp_path.iterdir())


def test_a_frame_keeps_its_limit_of_expansion_and_holds_the_same_rows(tmp_path: Path) -> None:
    rows = np.zeros(50_000, [("x", "<u2"), ("y", "u1")])
    limit = Expansion(1 << 16, 64)
    stream = RowStream(tmp_path, rows.dtype, len(rows), limit)
    stream.put(0, rows)
    for frame in (bytes(stream.frame()), pack(rows, limit)):
        assert rows.nbytes / 80 < len(frame) and limit.allows(rows.nbytes, len(frame))
        assert not unpack(frame, rows.dtype, len(rows), "rows").any()
    assert len(pack(rows)) < 100
    assert pack(rows, Expansion(rows.nbytes, 64)) == pack(rows)


def test_a_frame_of_more_bytes_than_the_index_counts_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zstd_frame, "MAX_FRAME_BYTES", 30)
    stream = RowStream(tmp_path, np.dtype([("x", "<u2")]), 50)
    stream.put(0, np.array([(i * i,) for i in range(50)], [("x", "<u2")]))
    with pytest.raises(BadRequestError, match=r"a voxel of 50 rows takes \d+ bytes, a record holds 30"):
        stream.frame()
