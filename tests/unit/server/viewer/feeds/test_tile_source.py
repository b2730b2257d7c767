"""Test tiles as messages: coarser details are beginnings, and memory is bounded."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from page_arrays import decoded
from solidcloud.schemas.wire.tile_messages import MAX_DETAIL, TileAnswer
from solidcloud.server.viewer.feeds.tile_source import TileSource, coarse_first
from solidcloud.server.viewer.page.view_frame import ViewFrame


@pytest.mark.parametrize("count", [0, 1, 3, 4, 5, 1000, 4**8 + 1])
def test_beginning_of_the_order_is_every_coarser_detail(count: int) -> None:
    order = coarse_first(count)
    assert np.array_equal(np.sort(order), np.arange(count))
    for detail in range(MAX_DETAIL + 1):
        kept = np.arange(0, count, 4**detail)
        assert np.array_equal(np.sort(order[: len(kept)]), kept)


def tile(points: int, colours: bool = True) -> TileAnswer:
    """Return a tile of points in a row."""
    places = np.zeros((points, 3), np.uint16)
    places[:, 0] = np.arange(points)
    pose = np.eye(4)
    pose[:3, 3] = (100.0, 0.0, 0.0)
    rgb = np.full((points, 3), 7 if colours else 0, np.uint8)
    none = np.empty(0)
    return TileAnswer(
        pose[None],
        0.5,
        points,
        0.01,
        places,
        none.astype("u2"),
        rgb,
        np.arange(points, dtype="f4"),
        none.astype("u1"),
        none.astype("u2"),
    )


class Reader:
    """Server that counts the tiles that it is asked for."""

    def __init__(self, answer: TileAnswer) -> None:
        self.answer, self.asked = answer, 0

    def tile(self, *_: Any) -> TileAnswer:
        self.asked += 1
        return self.answer


def source_of(reader: Reader, budget: int) -> TileSource:
    scene = SimpleNamespace(
        info=SimpleNamespace(generation=0), reader=reader, frame=ViewFrame([[90, 0, 0], [110, 0, 0]])
    )
    return TileSource(lambda: scene, budget)  # type: ignore[arg-type, return-value]


def test_tile_is_in_the_frame_of_the_page_with_its_columns() -> None:
    message = source_of(Reader(tile(20)), 1 << 20).tile((0, 1, 2, 3, 2))
    header, arrays = decoded(message or b"")
    assert header["key"] == [0, 1, 2, 3]
    assert (header["detail"], header["step"], header["total"]) == (2, 0.5, 20)
    assert np.array(header["matrix"])[:3, 3].tolist() == [0.0, 0.0, 0.0]
    assert set(arrays) == {"points", "rgb", "intensity"}
    assert np.array_equal(arrays["points"][:, 0], arrays["intensity"])
    assert set(arrays["points"][:5, 0].tolist()) == {0, 4, 8, 12, 16}


def test_tile_is_read_once_and_the_oldest_is_dropped_beyond_the_budget() -> None:
    reader = Reader(tile(1000))
    size = len(source_of(reader, 1 << 20).tile((0, 0, 0, 0, 0)) or b"")
    source = source_of(reader, 2 * size)
    reader.asked = 0
    for k in (0, 1, 0, 2, 0):
        source.tile((0, k, 0, 0, 0))
    assert reader.asked == 3  # 0 was used again, so that 1 was dropped for 2
    source.tile((0, 1, 0, 0, 0))
    assert reader.asked == 4
