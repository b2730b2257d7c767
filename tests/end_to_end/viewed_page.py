"""A browser on the viewer's page, for tests: Chromium of the system, driven by Playwright.

What a test waits for is a condition with a deadline. The page's policy forbids `eval`, so conditions
are evaluated by the debugger and not by `wait_for_function`.
"""

import io
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
DEADLINE = 90.0
needs_chromium = pytest.mark.skipif(CHROMIUM is None, reason="no chromium in PATH: apt-get install chromium")
_OPTIONS = [
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    # Nothing of the browser itself asks other hosts.
    "--disable-background-networking",
    "--disable-component-update",
]
_LIGHT = '{"budget": 0.1, "shading": false}'
# Part of the picture without panels, in pixels of 1280 x 720: left, top, right, bottom.
PICTURE = (20, 90, 940, 640)
BACKGROUND = np.array([10, 14, 21])


class ViewedPage:
    """A page of the viewer. errors: of its console.  requests: addresses that it asked for."""

    def __init__(self, page: Any) -> None:
        self.page = page
        self.errors: list[str] = []
        self.requests: list[str] = []
        page.on("console", lambda message: self._note(message.type, message.text))
        page.on("pageerror", lambda error: self.errors.append(str(error)))
        page.on("request", lambda request: self.requests.append(request.url))
        page.on("websocket", lambda socket: self.requests.append(socket.url))

    def _note(self, kind: str, text: str) -> None:
        if kind == "error":
            self.errors.append(text)

    def read(self, expression: str) -> Any:
        """Return the value of an expression of `window.solidcloud`, which is `s` in it."""
        return self.page.evaluate(f"(() => {{ const s = window.solidcloud; return s && ({expression}); }})()")

    def wait(self, expression: str, matches: Callable[[Any], bool] = bool) -> Any:
        """Return the value of an expression as soon as it matches."""
        end = time.monotonic() + DEADLINE
        while not matches(value := self.read(expression)):
            assert time.monotonic() < end, f"{expression} is still {value!r}; errors {self.errors}"
            self.page.wait_for_timeout(50)
        return value

    def wait_complete(self) -> None:
        """Wait until the user stands and every tile has arrived and is drawn."""
        self.wait("s.place !== null && s.shown > 0 && s.complete")

    @contextmanager
    def held(self, *keys: str) -> Iterator[None]:
        """Hold keys down during the block."""
        for key in keys:
            self.page.keyboard.down(key)
        try:
            yield
        finally:
            for key in keys:
                self.page.keyboard.up(key)

    def picture(self) -> np.ndarray:
        """Return the pixels (h, w, 3) of the part without panels, as shown."""
        image = Image.open(io.BytesIO(self.page.screenshot())).convert("RGB")
        return np.asarray(image.crop(PICTURE)).astype(int)

    def check_clean(self, url: str) -> None:
        """Check that nothing failed, and that no request left for another address."""
        assert self.errors == []
        here = urlsplit(url).netloc
        assert {urlsplit(each).netloc for each in self.requests} == {here}, self.requests


@contextmanager
def browsing() -> Iterator[Any]:
    """Run Chromium; yield Playwright's browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=_OPTIONS)
        try:
            yield browser
        finally:
            browser.close()


@contextmanager
def viewed_page(browser: Any, url: str, *, full: bool = False, before: str = "") -> Iterator[ViewedPage]:
    """Open a page of its own profile, 1280 x 720 pixels.

    full: with the settings of a new user; otherwise few points are drawn, which is faster without a
    graphics processor.  before: JavaScript that runs before the page's own.
    """
    context = browser.new_context(viewport={"width": 1280, "height": 720})
    if before:
        context.add_init_script(before)
    if not full:
        context.add_init_script(f"localStorage.setItem('solidcloud.settings', '{_LIGHT}')")
    try:
        viewed = ViewedPage(context.new_page())
        viewed.page.goto(url)
        yield viewed
    finally:
        context.close()


def coloured(picture: np.ndarray) -> float:
    """Return the share of pixels that differ from the background."""
    return float((np.abs(picture - BACKGROUND).max(axis=-1) > 12).mean())
