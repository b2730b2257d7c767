"""Video files: frames encoded by Chromium (WebCodecs, VP9), and written as WebM.

Playwright records videos with a program of its own, which is not part of the package. WebM is a
profile of Matroska (RFC 9559): elements of an id, a length and content.
"""

import base64
import io
import struct
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from PIL import Image

CODEC = "vp09.00.31.08"
# A player seeks to key frames [s].
_KEY_SECONDS = 10
# Frames of one message to the page.
_BATCH = 24
# WebCodecs needs a secure context, which this address is; nothing is asked of the network.
_ADDRESS = "https://video.invalid/"

_BEGIN = """([codec, width, height, rate, bits]) => {
  window.chunks = [];
  window.encoder = new VideoEncoder({
    output: (chunk) => {
      const content = new Uint8Array(chunk.byteLength);
      chunk.copyTo(content);
      let text = "";
      for (const each of content) text += String.fromCharCode(each);
      window.chunks.push([chunk.timestamp, chunk.type === "key", btoa(text)]);
    },
    error: (error) => { window.failed = String(error); },
  });
  window.encoder.configure({
    codec, width, height, bitrate: bits, framerate: rate, latencyMode: "quality", bitrateMode: "variable",
  });
}"""
_ENCODE = """async ([images, first, rate, keys]) => {
  for (const [k, image] of images.entries()) {
    const bytes = Uint8Array.from(atob(image), (each) => each.charCodeAt(0));
    const bitmap = await createImageBitmap(new Blob([bytes], { type: "image/png" }));
    const number = first + k;
    const frame = new VideoFrame(bitmap, {
      timestamp: Math.round((1e6 * number) / rate), duration: Math.round(1e6 / rate),
    });
    window.encoder.encode(frame, { keyFrame: number % keys === 0 });
    frame.close();
    bitmap.close();
  }
  while (window.encoder.encodeQueueSize > 4) await new Promise((resolve) => setTimeout(resolve, 20));
  return window.failed ?? null;
}"""
_END = "async () => { await window.encoder.flush(); return [window.failed ?? null, window.chunks]; }"


class Chunk(NamedTuple):
    """Encoded frame. time: of it in the video [ms].  key: whether it needs no other one."""

    time: int
    key: bool
    content: bytes


def encode(browser: Any, frames: Iterable[Image.Image], rate: int, bits: int) -> list[Chunk]:
    """Return frames, all of one size, encoded at a rate [1/s]. bits: of a second. Raise RuntimeError."""
    page = browser.new_page()
    try:
        page.route("**/*", lambda route: route.fulfill(body="<!doctype html>", content_type="text/html"))
        page.goto(_ADDRESS)
        number, batch = 0, []

        def send() -> None:
            problem = page.evaluate(_ENCODE, [batch, number, rate, _KEY_SECONDS * rate])
            if problem:
                raise RuntimeError(f"Chromium does not encode {CODEC}: {problem}")

        for frame in frames:
            if number == 0 and not batch:
                page.evaluate(_BEGIN, [CODEC, *frame.size, rate, bits])
            stream = io.BytesIO()
            frame.save(stream, "PNG", compress_level=1)
            batch.append(base64.b64encode(stream.getvalue()).decode())
            if len(batch) == _BATCH:
                send()
                number, batch = number + len(batch), []
        send()
        problem, chunks = page.evaluate(_END)
        if problem:
            raise RuntimeError(f"Chromium does not encode {CODEC}: {problem}")
        return [Chunk(round(when / 1000), key, base64.b64decode(text)) for when, key, text in chunks]
    finally:
        page.close()


def webm(chunks: Sequence[Chunk], size: tuple[int, int], rate: int) -> bytes:
    """Return a video file. size: width and height [pixels].  rate: frames a second."""
    duration = chunks[-1].time + 1000 / rate
    info = element(
        0x1549A966,
        element(0x2AD7B1, number(1_000_000))  # a tick is a millisecond
        + element(0x4489, float64(duration))
        + element(0x4D80, b"solidcloud")
        + element(0x5741, b"solidcloud"),
    )
    video = element(0xE0, element(0xB0, number(size[0])) + element(0xBA, number(size[1])))
    track = (
        element(0xD7, number(1))
        + element(0x73C5, number(1))
        + element(0x83, number(1))
        + element(0x23E383, number(round(1e9 / rate)))
        + element(0x86, b"V_VP9")
        + video
    )
    tracks = element(0x1654AE6B, element(0xAE, track))
    begin, clusters, cues = len(info) + len(tracks), b"", b""
    for group in clusters_of(chunks):
        position = element(0xF7, number(1)) + element(0xF1, number(begin + len(clusters)))
        cues += element(0xBB, element(0xB3, number(group[0].time)) + element(0xB7, position))
        blocks = b"".join(
            element(
                0xA3, b"\x81" + (each.time - group[0].time).to_bytes(2, "big") + flags(each) + each.content
            )
            for each in group
        )
        clusters += element(0x1F43B675, element(0xE7, number(group[0].time)) + blocks)
    header = b"".join(
        element(name, content)
        for name, content in (
            (0x4286, number(1)),
            (0x42F7, number(1)),
            (0x42F2, number(4)),
            (0x42F3, number(8)),
            (0x4282, b"webm"),
            (0x4287, number(4)),
            (0x4285, number(2)),
        )
    )
    segment = info + tracks + clusters + element(0x1C53BB6B, cues)
    return element(0x1A45DFA3, header) + element(0x18538067, segment)


def clusters_of(chunks: Sequence[Chunk]) -> list[list[Chunk]]:
    """Return chunks in groups that begin with a key frame."""
    groups: list[list[Chunk]] = []
    for chunk in chunks:
        if chunk.key:
            groups.append([])
        groups[-1].append(chunk)
    return groups


def flags(chunk: Chunk) -> bytes:
    """Return the flags of a block."""
    return b"\x80" if chunk.key else b"\x00"


def element(name: int, content: bytes) -> bytes:
    """Return an element. name: its id, with the bits of its length."""
    return (
        name.to_bytes((name.bit_length() + 7) // 8, "big")
        + (len(content) | 1 << 56).to_bytes(8, "big")
        + content
    )


def number(value: int) -> bytes:
    """Return an unsigned number as content."""
    return value.to_bytes(max(1, (value.bit_length() + 7) // 8), "big")


def float64(value: float) -> bytes:
    """Return a number as content."""
    return struct.pack(">d", value)
