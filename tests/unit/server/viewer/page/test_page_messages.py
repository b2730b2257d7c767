"""Test the messages between process and page: arrays are read back, invalid texts are refused."""

import numpy as np
import pytest
from page_arrays import decoded
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.viewer.page.page_messages import (
    Hello,
    Intent,
    Want,
    binary_message,
    read_message,
    text_message,
)


def test_arrays_are_read_back(rng: np.random.Generator) -> None:
    given = {
        "points": rng.integers(0, 1 << 16, (7, 3)).astype(np.uint16),
        "rgb": rng.integers(0, 256, (7, 3)).astype(np.uint8),
        "empty": np.empty((0, 3), np.float32),
        "wide": rng.normal(size=5).astype(">f8"),
        "strided": np.arange(20, dtype=np.int32)[::3],
    }
    header, arrays = decoded(binary_message("tile", given, key=[0, 1, -2, 3], step=0.5))
    assert header == {"type": "tile", "key": [0, 1, -2, 3], "step": 0.5}
    assert list(arrays) == list(given)
    for name, array in given.items():
        assert np.array_equal(arrays[name], array), name


def test_texts_of_a_page_are_read() -> None:
    assert read_message(text_message("hello", version=1, at=[1, 2, 3, 90])) == Hello(1, (1.0, 2.0, 3.0, 90.0))
    assert read_message(text_message("intent", forward=1, yaw=-0.5)) == Intent(forward=1.0, yaw=-0.5)
    assert read_message(text_message("want", tiles=[[0, 1, -2, 3, 4]])) == Want([(0, 1, -2, 3, 4)])


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{}",
        "[]",
        '{"type":"other"}',
        '{"type":"hello"}',
        '{"type":"hello","version":1,"at":[1,2,3]}',
        '{"type":"hello","version":1,"at":[1,2,1e300,0]}',
        '{"type":"intent","forward":1.5}',
        '{"type":"intent","forward":NaN}',
        '{"type":"intent","yaw":1e999}',
        '{"type":"want","tiles":[[0,0,0,0,9]]}',
        '{"type":"want","tiles":[[0,0,0,0,-1]]}',
        '{"type":"want","tiles":[[0,0,0,4294967296,1]]}',
        text_message("want", tiles=[[0, 0, 0, 0, 0]] * 257),
        '{"type":"boom","place":[0,0,0],"way":[0,0,1],"reach":0}',
        '{"type":"save","form":"exe"}',
        text_message("path", name="a" * 256, text="", first=True, last=True),
        text_message("path", name="a.csv", text="a" * 10_001, first=True, last=True),
        b'{"type":"intent"}',
    ],
)
def test_invalid_texts_are_refused(text: str) -> None:
    with pytest.raises(BadRequestError):
        read_message(text)
