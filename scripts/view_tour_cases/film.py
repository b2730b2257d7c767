"""Film of the tour: what Chromium shows while a page is driven, and the frames of a video of it."""

import base64
import io
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from typing import Any, NamedTuple

from PIL import Image, ImageDraw

from .tour_page import TourPage
from .tour_strip import GROUND, TEXT, caption_font

# Frames of the video a second: a page that is drawn in software has about as many pictures.
RATE = 12
_QUALITY = 92
_CAPTION, _SIZE, _LEFT = 36, 18, 12
# The last picture of a shot stays for this time [s].
_STAY = 0.6


class Shot(NamedTuple):
    """Part of a film.

    caption: below it.  pictures: (time of the picture [s, since the epoch], JPEG file), in order.
    end: of the shot [s].
    """

    caption: str
    pictures: list[tuple[float, bytes]]
    end: float


@contextmanager
def shot(page: TourPage, caption: str, film: list[Shot]) -> Iterator[None]:
    """Append a shot of a page to a film: what the page shows during the block."""
    session = page.page.context.new_cdp_session(page.page)
    pictures: list[tuple[float, bytes]] = []

    def take(event: dict[str, Any]) -> None:
        pictures.append((event["metadata"]["timestamp"], base64.b64decode(event["data"])))
        session.send("Page.screencastFrameAck", {"sessionId": event["sessionId"]})

    session.on("Page.screencastFrame", take)
    begin = time.time()
    session.send("Page.startScreencast", {"format": "jpeg", "quality": _QUALITY})
    yield
    session.send("Page.stopScreencast")
    session.detach()
    kept = [each for each in pictures if each[0] >= begin] or pictures[-1:]
    film.append(Shot(caption, kept, time.time()))


def frames(film: Sequence[Shot], size: tuple[int, int]) -> Iterator[Image.Image]:
    """Yield the frames of a film's video, `RATE` a second, each with its caption.

    size: width and height [pixels] of the pictures; below them is the caption (see `frame_size`).
    """
    font = caption_font(_SIZE)
    for each in film:
        caption = Image.new("RGB", (size[0], _CAPTION), GROUND)
        ImageDraw.Draw(caption).text((_LEFT, _CAPTION / 2), each.caption, TEXT, font, anchor="lm")
        times = [when for when, _ in each.pictures]
        ends = [*times[1:], max(each.end, times[-1]) + _STAY]
        done = 0
        for (_, content), end in zip(each.pictures, ends, strict=True):
            # A picture is in as many frames as it was shown.
            until = round((end - times[0]) * RATE)
            if until <= done:
                continue
            made = Image.new("RGB", frame_size(size), GROUND)
            picture = Image.open(io.BytesIO(content)).convert("RGB")
            made.paste(picture.resize(size, Image.Resampling.LANCZOS), (0, 0))
            made.paste(caption, (0, size[1]))
            for _ in range(until - done):
                yield made
            done = until


def frame_size(size: tuple[int, int]) -> tuple[int, int]:
    """Return width and height of a frame whose picture has a size [pixels]."""
    return size[0], size[1] + _CAPTION


def pace(film: Sequence[Shot]) -> float:
    """Return how many pictures a second a film has in the median."""
    gaps = sorted(later - earlier for each in film for (earlier, _), (later, _) in pairwise(each.pictures))
    return 1 / gaps[len(gaps) // 2] if gaps else 0.0
