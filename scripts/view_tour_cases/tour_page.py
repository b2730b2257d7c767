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
PATIENCE = 300.0
# Around the picture of a part of the page [pixels].
_MARGIN = 12
# Radians of a pixel by which the pointer drags the view (assets/input.js).
_PER_PIXEL = 0.0042
# All of a new user's settings that a scene changes; the pictures have many points.
_SETTINGS = {"budget": 2.0, "panel": False, "instruments": False, "openPlots": False, "walked": True}
_BARE = "aside, header, footer, button, #notices { display: none !important; } #view { outline: none !important; }"


class TourPage:
    """Page of one user.

    page: Playwright's.  address: of the viewer, with the user's place.  bare: without panels.
    """

    def __init__(self, page: Any, address: str, *, bare: bool = False) -> None:
        self.page = page
        self.address = address
        self.bare = bare

    def open(self) -> None:
        """Show the viewer."""
        self.page.goto(self.address)
        if self.bare:
            self.page.add_style_tag(content=_BARE)

    def wait(self, expression: str, most: float | None = None) -> None:
        """Wait until an expression of `window.solidcloud`, `s`, holds.

        most: no longer than this time [s]; otherwise raise TimeoutError after `PATIENCE`.
        """
        end = time.monotonic() + (PATIENCE if most is None else most)
        while not self.read(f"Boolean({expression})"):
            if time.monotonic() > end:
                if most is not None:
                    return
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

    def look(self, yaw: float, pitch: float = 0.0, seconds: float = 0.0) -> None:
        """Drag the view by angles [degrees], to the left and up, for some seconds."""
        pixels = [math.radians(angle) / _PER_PIXEL for angle in (yaw, pitch)]
        mouse, (x, y) = self.page.mouse, self._middle()
        mouse.move(x, y)
        mouse.down()
        begin, share = time.monotonic(), 0.0
        while share < 1:
            share = min(1.0, (time.monotonic() - begin) / seconds) if seconds else 1.0
            # Begins and ends slowly.
            eased = share * share * (3 - 2 * share)
            mouse.move(x - pixels[0] * eased, y - pixels[1] * eased, steps=1 if seconds else 4)
            if seconds:
                self.rest(0.03)
        mouse.up()

    def zoom(self, steps: int) -> None:
        """Turn the wheel. steps: away from the user, if positive."""
        self.page.mouse.move(*self._middle())
        for _ in range(abs(steps)):
            self.page.mouse.wheel(0, 100 if steps > 0 else -100)

    def rest(self, seconds: float) -> None:
        """Do nothing for some seconds."""
        self.page.wait_for_timeout(1000 * seconds)

    def _middle(self) -> tuple[float, float]:
        size = self.page.viewport_size
        return size["width"] / 2, size["height"] / 2

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
    browser: Any,
    url: str,
    at: str,
    *,
    size: tuple[int, int] = SIZE,
    bare: bool = False,
    arrived: bool = True,
    **settings: Any,
) -> Iterator[TourPage]:
    """Make a page of a new user, who stands at a place.

    at: x, y, z [m] and direction [degrees] in the world, as in a link.  size: of the page [pixels].
    bare: without panels.  arrived: open the page, and wait until the user stands.  settings: of the page.
    """
    context = browser.new_context(viewport={"width": size[0], "height": size[1]})
    context.set_default_timeout(1000 * PATIENCE)
    chosen = json.dumps(json.dumps({**_SETTINGS, **settings}))
    context.add_init_script(f"localStorage.setItem('solidcloud.settings', {chosen})")
    try:
        page = TourPage(context.new_page(), f"{url}?at={at}", bare=bare)
        if arrived:
            page.open()
            page.wait("s.place !== null")
        yield page
    finally:
        context.close()


def _image(content: bytes) -> Image.Image:
    return Image.open(io.BytesIO(content)).convert("RGB")
