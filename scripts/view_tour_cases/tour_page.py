"""Page of the viewer in Chromium, driven as a user does: keys, pointer, panels."""

import io
import json
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from PIL import Image

SIZE = (1280, 720)
# A graphics card is not needed: SwiftShader draws.
OPTIONS = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist")
# A server may compile its kernels first [s].
PATIENCE = 600.0
# Around the picture of a part of the page [pixels].
_MARGIN = 12
# Radians of a pixel by which the pointer drags the view (assets/input.js).
_PER_PIXEL = 0.0042
# All of a new user's settings that a scene changes; the pictures have many points.
_SETTINGS = {"budget": 2.0, "panel": False, "instruments": False, "openPlots": False, "walked": True}
_BARE = "aside, header, footer, button, #notices { display: none !important; } #view { outline: none !important; }"


class TourPage:
    """Page of one user. page: Playwright's."""

    def __init__(self, page: Any) -> None:
        self.page = page

    def wait(self, expression: str) -> None:
        """Wait until an expression of `window.solidcloud`, `s`, holds. Raise TimeoutError."""
        end = time.monotonic() + PATIENCE
        while not self.read(f"Boolean({expression})"):
            if time.monotonic() > end:
                state = self.read("[s.place, s.verdict, s.missing, s.shown, s.fps, s.notices]")
                raise TimeoutError(
                    f"{self.page.url}: {expression} does not hold after {PATIENCE:g} s; the page has {state}"
                )
            self.page.wait_for_timeout(50)

    def read(self, expression: str) -> Any:
        """Return the value of an expression of `window.solidcloud`, `s`."""
        return self.page.evaluate(f"(() => {{ const s = window.solidcloud; return s && ({expression}); }})()")

    def hold(self, keys: str, until: str) -> None:
        """Hold keys until an expression holds."""
        self.press(keys)
        self.wait(until)
        self.release(keys)

    def press(self, keys: str) -> None:
        """Press keys, and hold them."""
        for key in keys:
            self.page.keyboard.down(key)

    def release(self, keys: str) -> None:
        """Release keys."""
        for key in keys:
            self.page.keyboard.up(key)

    def look(self, yaw: float, pitch: float = 0.0) -> None:
        """Drag the view by angles [degrees], to the left and up."""
        pixels = [math.radians(angle) / _PER_PIXEL for angle in (yaw, pitch)]
        mouse, start = self.page.mouse, (SIZE[0] / 2, SIZE[1] / 2)
        mouse.move(*start)
        mouse.down()
        mouse.move(start[0] - pixels[0], start[1] - pixels[1], steps=4)
        mouse.up()

    def zoom(self, steps: int) -> None:
        """Turn the wheel. steps: away from the user, if positive."""
        self.page.mouse.move(SIZE[0] / 2, SIZE[1] / 2)
        for _ in range(abs(steps)):
            self.page.mouse.wheel(0, 100 if steps > 0 else -100)

    def picture(self, *, bare: bool = True, complete: bool = True) -> Image.Image:
        """Return the page. bare: without panels.  complete: once every point is drawn."""
        style = self.page.add_style_tag(content=_BARE) if bare else None
        # A notice of the start has gone.
        self.wait("s.complete" if complete else "true")
        self.page.wait_for_timeout(400)
        image = _image(self.page.screenshot())
        if style is not None:
            style.evaluate("each => each.remove()")
        return image

    def panel(self, selector: str) -> Image.Image:
        """Return the picture of one part of the page, with a margin."""
        part = self.page.locator(selector).first
        part.scroll_into_view_if_needed()
        box = part.bounding_box()
        clip = {name: box[name] - _MARGIN for name in ("x", "y")}
        clip |= {name: box[name] + 2 * _MARGIN for name in ("width", "height")}
        return _image(self.page.screenshot(clip=clip))


@contextmanager
def tour_page(
    browser: Any, url: str, at: str, *, size: tuple[int, int] = SIZE, **settings: Any
) -> Iterator[TourPage]:
    """Open a page of a new user, who stands at a place.

    at: x, y, z [m] and direction [degrees] in the world, as in a link.  settings: of the page.
    """
    context = browser.new_context(viewport={"width": size[0], "height": size[1]})
    context.set_default_timeout(1000 * PATIENCE)
    chosen = json.dumps(json.dumps({**_SETTINGS, **settings}))
    context.add_init_script(f"localStorage.setItem('solidcloud.settings', {chosen})")
    try:
        page = TourPage(context.new_page())
        page.page.goto(f"{url}?at={at}")
        page.wait("s.place !== null")
        yield page
    finally:
        context.close()


def _image(content: bytes) -> Image.Image:
    return Image.open(io.BytesIO(content)).convert("RGB")
