"""Test the tour's video: the file's elements, and how pictures become frames."""

import io
from collections.abc import Iterator

import numpy as np
from PIL import Image
from view_tour_cases.film import RATE, Shot, frame_size, frames
from view_tour_cases.webm import Chunk, webm

SEGMENT, CLUSTER, CUES, BLOCK, INFO, DURATION, TIME = (
    0x18538067, 0x1F43B675, 0x1C53BB6B, 0xA3, 0x1549A966, 0x4489, 0xE7,
)  # fmt: skip


def elements(content: bytes) -> Iterator[tuple[int, bytes, int]]:
    """Yield id, content and first byte of the elements of a file or of an element."""
    at = 0
    while at < len(content):
        begin = at
        wide = 9 - content[at].bit_length()
        name = int.from_bytes(content[at : at + wide], "big")
        at += wide
        wide = 9 - content[at].bit_length()
        size = int.from_bytes(content[at : at + wide], "big") & (1 << 7 * wide) - 1
        at += wide
        assert at + size <= len(content)
        yield name, content[at : at + size], begin
        at += size


def test_file_has_all_chunks_in_clusters_that_begin_with_key_frames() -> None:
    chunks = [Chunk(100 * k, k % 3 == 0, bytes([k]) * (k + 1)) for k in range(8)]
    (_, header, _), (name, segment, _) = elements(webm(chunks, (64, 40), 10))
    assert b"webm" in header
    assert name == SEGMENT
    found, places = [], []
    for name, content, begin in elements(segment):
        if name == CLUSTER:
            places.append(begin)
            (first, time, _), *blocks = elements(content)
            assert first == TIME
            for k, (kind, block, _) in enumerate(blocks):
                assert kind == BLOCK
                assert block[0] == 0x81
                assert (block[3] == 0x80) == (k == 0)
                when = int.from_bytes(time, "big") + int.from_bytes(block[1:3], "big")
                found.append(Chunk(when, block[3] == 0x80, block[4:]))
        if name == CUES:
            points = [
                dict((kind, part) for kind, part, _ in elements(each)) for _, each, _ in elements(content)
            ]
            listed = [
                int.from_bytes(dict((k, v) for k, v, _ in elements(each[0xB7]))[0xF1], "big")
                for each in points
            ]
            assert listed == places
        if name == INFO:
            duration = next(part for kind, part, _ in elements(content) if kind == DURATION)
            assert np.frombuffer(duration, ">f8")[0] == 800
    assert found == chunks


def test_pictures_are_shown_as_long_as_they_were_on_the_page() -> None:
    def picture(grey: int) -> bytes:
        stream = io.BytesIO()
        Image.new("RGB", (32, 18), (grey, grey, grey)).save(stream, "JPEG")
        return stream.getvalue()

    first, later = 1.7e9, 1.7e9 + 2.0
    made = list(
        frames([Shot("A caption", [(first, picture(40)), (later, picture(200))], later + 1.0)], (64, 36))
    )
    assert all(each.size == frame_size((64, 36)) for each in made)
    shown = [each.getpixel((5, 5))[0] for each in made]
    assert shown[: 2 * RATE] == [40] * 2 * RATE
    assert set(shown[2 * RATE :]) == {200}
    assert len(shown) > 3 * RATE
    assert made[0].crop((0, 36, *made[0].size)).getcolors(1) is None, "no caption"
