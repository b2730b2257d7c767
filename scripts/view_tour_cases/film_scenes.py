"""Scenes of the film of the tour, each a shot of some seconds."""

from collections.abc import Callable, Sequence
from typing import Any

from .film import Shot, shot
from .scenes import INSTRUMENTS, check, clash_path
from .tour_page import tour_page

# Pages are small: their panels can be read in the video, and their pictures are drawn sooner.
SIZE = (960, 540)
# Views without panels.
_BARE = {"size": SIZE, "bare": True}


def arrive(browser: Any, url: str, film: list[Shot]) -> None:
    """Film the page from its first picture, and a turn before the portal."""
    with tour_page(browser, url, "3.4,-10.2,0.1,112", arrived=False, **_BARE) as page:
        page.open()
        page.wait("s.pictured")
        with shot(page, "Arrive: the scan streams in by level of detail", film):
            page.wait("s.complete", most=4.0)
            page.look(-14, 0, 1.5)
            page.wait("s.complete", most=2.0)


def walk(browser: Any, url: str, film: list[Shot]) -> None:
    """Film a user who passes the door and its steps."""
    with tour_page(browser, url, "0.1,-3.9,0.1,90", **_BARE) as page:
        page.wait("s.complete")
        with shot(page, "Walk: the server moves you, up steps and through the door", film):
            page.rest(0.5)
            page.hold("w", "s.place[1] > 0.3")
            page.wait("s.complete", most=2.0)


def touch(browser: Any, url: str, film: list[Shot]) -> None:
    """Film a user whom the cloister's wall stops, and who slides along it."""
    with tour_page(browser, url, "-7.9,-9.4,0.1,130", **_BARE) as page:
        page.zoom(-4)
        page.wait("s.complete")
        with shot(page, "Touch: walls stop you; contacts and their normals", film):
            page.rest(0.5)
            page.press("wa")
            page.wait("s.verdict === 'stopped' && s.contacts > 0")
            page.wait("s.complete", most=3.0)
            page.rest(1.5)
        page.release("wa")


def residency(browser: Any, url: str, film: list[Shot]) -> None:
    """Film the voxels in memory around a user who walks."""
    with tour_page(browser, url, "-4,-12,0.1,72", boxes=True, **_BARE) as page:
        page.wait("s.complete")
        with shot(page, "Voxels in memory, and those that are read ahead", film):
            page.rest(0.5)
            page.hold("w", "s.place[1] > -9.2")
            page.wait("s.complete", most=2.0)
            page.rest(0.5)


def hierarchy(browser: Any, url: str, film: list[Shot]) -> None:
    """Film the levels of the hierarchy of bounding spheres."""
    options = {**INSTRUMENTS, "openHierarchy": True, "level": 0}
    with tour_page(browser, url, "-4.1,-6.7,0.1,112", size=SIZE, **options) as page:
        page.wait("s.spheres && s.spheres.level === 0 && s.spheres.drawn > 0 && s.complete")
        with shot(page, "The hierarchy of bounding spheres, level by level", film):
            page.rest(0.8)
            for level in (1, 2, 3, 4):
                page.page.get_by_label("Level", exact=True).press("ArrowRight")
                page.wait(f"s.spheres.level === {level} && s.spheres.drawn > 0 && s.complete")
                page.rest(0.7)


def plots(browser: Any, url: str, film: list[Shot]) -> None:
    """Film the live plots while the user walks."""
    with tour_page(browser, url, "1.0,-10,0.1,97", **{**INSTRUMENTS, "openPlots": True}, size=SIZE) as page:
        page.hold("w", "s.place[1] > -7.5")
        page.hold("s", "s.place[1] < -9.8")
        page.wait("s.samples.length > 8")
        with shot(page, "Watch the server: live plots", film):
            page.rest(1.0)
            page.hold("w", "s.place[1] > -7.5")
            page.wait("s.complete", most=2.0)
            page.rest(1.5)


def clash(browser: Any, url: str, film: list[Shot]) -> None:
    """Film a path as it is checked, and three of its clashes."""
    with tour_page(browser, url, "-2,-7,0.1,75", size=SIZE, panel=True, near=0.05) as page:
        # The list is empty, and the input hidden: both are no places to scroll to.
        page.page.locator("#panel section:has(#clash-list)").evaluate("each => each.scrollIntoView()")
        page.wait("s.complete")
        with shot(page, "Check a path for clashes, and go to them", film):
            check(page, clash_path())
            page.rest(1.5)
            for _ in range(2):
                page.page.keyboard.press("Period")
                page.rest(1.5)


def meet(browser: Any, url: str, film: list[Shot]) -> None:
    """Film another user."""
    with (
        tour_page(browser, url, "-0.6,-2.9,0.1,-100", size=(320, 180), budget=0.1, shading=False) as other,
        tour_page(browser, url, "0.6,-6.6,0.1,100", **_BARE) as page,
    ):
        page.wait("s.others.length === 1 && s.complete")
        with shot(page, "Meet other users", film):
            other.hold("w", "s.place[1] < -5.2")
            page.rest(0.8)


SCENES: Sequence[Callable[[Any, str, list[Shot]], None]] = (
    arrive, walk, touch, residency, hierarchy, plots, clash, meet,
)  # fmt: skip


def film_of(browser: Any, url: str) -> list[Shot]:
    """Return the film of the tour."""
    film: list[Shot] = []
    for scene in SCENES:
        print(f"film: {scene.__name__}", flush=True)
        scene(browser, url, film)
    return film
