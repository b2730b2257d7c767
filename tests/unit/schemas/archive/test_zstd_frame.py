"""Test the limit of expansion of a frame, and that a frame too long for the index is refused."""

from pathlib import Path

import numpy as np
import pytest
from solidcloud.schemas.archive import zstd_frame
from solidcloud.schemas.archive.zstd_frame import Expansion, RowStream, pack, unpack
from solidcloud.schemas.errors import BadRequestError


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
