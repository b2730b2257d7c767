"""Scenes of the tour, in order: each drives a page and returns its picture."""

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from PIL import Image

from .tour_page import TourPage, tour_page
from .tour_strip import reduced

# Opens the panel of one instrument.
INSTRUMENTS = {"instruments": True, "openEffects": False, "openAccuracy": False, "openHierarchy": False}
# Twice the size of a frame of the strip: its charts and list can be read.
_SMALL = (896, 504)
# Way of the clash check: waypoints (x, y) [m] past a column, through the door, through a column
# of the nave and along its wall.
_WAYPOINTS = ((-7.0, -9.0), (-4.7, -5.4), (-0.2, -3.2), (0.0, 2.4), (3.4, 3.2), (5.6, 6.5), (7.3, 9.0))
_STEP = 0.05
# The stairs rise between these y; the feet stay 8 cm above them [m].
_STAIRS, _FLOORS, _ABOVE = (-2.9, -2.15), (0.0, 0.45), 0.08


# Panels without the scan behind them.
_PLAIN = """
aside, footer { background: #0f151f !important; }
.more, #title { display: none; }
#view, #raster { visibility: hidden; }
"""


class Scene(NamedTuple):
    """Scene of the tour. name: of its picture.  caption: under it.  take: returns its picture."""

    name: str
    caption: str
    take: Callable[[Any, str], Image.Image]


def arrive(browser: Any, url: str) -> Image.Image:
    """Return the user before the portal."""
    with tour_page(browser, url, "3.4,-10.2,0.1,112") as page:
        return page.picture()


def touch(browser: Any, url: str) -> Image.Image:
    """Return the user as it touches the cloister's wall, into which it still walks."""
    with tour_page(browser, url, "-8.0,-9.4,0.1,130") as page:
        page.zoom(-3)
        # To the left and ahead: the view is along the wall.
        page.press("wa")
        page.wait("s.verdict === 'stopped' && s.contacts > 0")
        return page.picture()


def door(browser: Any, url: str) -> Image.Image:
    """Return the user in the main door."""
    with tour_page(browser, url, "0.1,-0.6,0.5,90") as page:
        page.look(-4, 5)
        page.zoom(2)
        return page.picture()


def residency(browser: Any, url: str) -> Image.Image:
    """Return the voxels in memory as the user walks."""
    with tour_page(browser, url, "-4,-13,0.1,72", boxes=True) as page:
        page.hold("w", "s.place[1] > -10")
        return page.picture()


def hierarchy(browser: Any, url: str) -> Image.Image:
    """Return the bounding spheres at a column."""
    with tour_page(
        browser, url, "-4.1,-6.7,0.1,112", **{**INSTRUMENTS, "openHierarchy": True, "level": 3}
    ) as page:
        page.wait("s.spheres && s.spheres.level === 3 && s.spheres.drawn > 0")
        return page.picture()


def plots(browser: Any, url: str) -> Image.Image:
    """Return the page with the live plots after walks before the portal."""
    options = {**INSTRUMENTS, "openPlots": True, "size": _SMALL, "budget": 0.5}
    with tour_page(browser, url, "1.2,-11,0.1,97", **options) as page:
        pace(page)
        return page.picture(bare=False)


def pace(page: TourPage) -> None:
    """Walk to and fro before the portal, until the plots have something to show."""
    page.hold("w", "s.place && s.place[1] > -7.5")
    page.hold("s", "s.place && s.place[1] < -10")
    page.hold("w", "s.place && s.place[1] > -9")
    page.wait("s.samples.length > 12")


def clash(browser: Any, url: str) -> Image.Image:
    """Return the page at the deepest clash of a path."""
    with tour_page(browser, url, "-2,-7,0.1,75", size=_SMALL, budget=0.8, panel=True, near=0.05) as page:
        check(page, clash_path())
        return page.picture(bare=False)


def meet(browser: Any, url: str) -> Image.Image:
    """Return what one user sees of another."""
    with (
        tour_page(browser, url, "-1.1,-3.6,0.1,-95", size=(320, 180), budget=0.1, shading=False) as other,
        tour_page(browser, url, "0.6,-6.6,0.1,100") as page,
    ):
        page.wait("s.others.length === 1")
        other.hold("w", "s.place[1] < -4.2")
        return page.picture()


def check(page: TourPage, path: str) -> None:
    """Check a path, and go to its deepest clash."""
    page.page.get_by_label("Load a path").set_input_files(
        {"name": "cart.csv", "mimeType": "text/csv", "buffer": path.encode()}
    )
    page.wait("s.clash.state === 'done'")
    page.page.locator("#clash-list button").first.click()
    page.wait("s.watching && s.clash.shown")


def clash_path() -> str:
    """Return the path of the clash check as the text of a CSV file, upright poses each 5 cm."""
    rows = ["t,x,y,z,qw,qx,qy,qz"]
    for (x0, y0), (x1, y1) in pairwise(_WAYPOINTS):
        steps = round(((x1 - x0) ** 2 + (y1 - y0) ** 2) ** 0.5 / _STEP)
        for step in range(steps):
            x, y = (a + (b - a) * step / steps for a, b in ((x0, x1), (y0, y1)))
            rise = min(1.0, max(0.0, (y - _STAIRS[0]) / (_STAIRS[1] - _STAIRS[0])))
            z = _FLOORS[0] + rise * (_FLOORS[1] - _FLOORS[0]) + _ABOVE
            rows.append(f"{(len(rows) - 1) * _STEP:.2f},{x:.4f},{y:.4f},{z:.4f},1,0,0,0")
    return "\n".join(rows) + "\n"


SCENES: Sequence[Scene] = (
    Scene("arrive", "Arrive: the scan streams in by level of detail", arrive),
    Scene("touch", "Touch: contacts and their normals", touch),
    Scene("door", "Pass the door, up its steps", door),
    Scene("residency", "See which voxels are in memory", residency),
    Scene("hierarchy", "See the hierarchy of bounding spheres", hierarchy),
    Scene("plots", "Watch the server: live plots", plots),
    Scene("clash", "Check a path for clashes", clash),
    Scene("meet", "Meet other users", meet),
)


def panel_pictures(browser: Any, url: str, folder: Path) -> list[Path]:
    """Write the picture of each panel of the guide; return their files."""
    written = []

    def write(name: str, image: Image.Image) -> None:
        path = folder / f"{name}.png"
        reduced(image, 200).save(path, optimize=True)
        written.append(path)

    # A high page, on which no panel scrolls, and which is not a small screen with one column.
    light = {"size": (1000, 1700), "budget": 0.1, "shading": False}
    with tour_page(
        browser, url, "1.2,-11,0.1,97", **light, **{**INSTRUMENTS, "openPlots": True}, panel=True
    ) as page:
        page.page.add_style_tag(content=_PLAIN)
        pace(page)
        write("plots", page.panel("#instruments section:nth-of-type(1)"))
        write("settings", page.panel("#panel section:nth-of-type(2)"))
        write("colour", page.panel("#panel section:nth-of-type(1)"))
        write("status", page.panel("#status"))
        for number, name in enumerate(("Effects", "Accuracy", "Hierarchy"), 2):
            page.page.locator(f"#instrument-open{name}-title button").click()
            page.wait(
                {"Effects": "s.effects.length", "Accuracy": "s.measured", "Hierarchy": "s.spheres"}[name]
            )
            page.page.wait_for_timeout(1500)
            write(name.lower(), page.panel(f"#instruments section:nth-of-type({number})"))
        check(page, clash_path())
        page.page.wait_for_timeout(500)
        write("clash", page.panel("#panel section:has(#clash-list)"))
    return written
