"""Checks of drawn figures: colours that differ in grey, texts that overlap, panels that fill the figure."""

from collections.abc import Iterator
from contextlib import contextmanager
from itertools import combinations, pairwise
from typing import Any
from unittest.mock import patch

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.legend import Legend
from matplotlib.lines import Line2D
from matplotlib.text import Text
from matplotlib.transforms import Bbox

# Least difference of lightness (CIE L*, 0 to 100) of two colours that a legend tells apart.
LEAST_STEP = 7.5
# Overlap that is no fault [pixels].
TOUCH = 1.0


@contextmanager
def drawn_figures() -> Iterator[list[Figure]]:
    """Yield a list of the figures that are saved in the `with`; they are saved as usual."""
    found: list[Figure] = []
    save = Figure.savefig

    def saved(self: Figure, *arguments: Any, **options: Any) -> None:
        save(self, *arguments, **options)
        FigureCanvasAgg(self).draw()  # the layout is final from here on
        found.append(self)

    with patch.object(Figure, "savefig", saved):
        yield found


def lightness(colour: Any) -> float:
    """Return the lightness L* of a colour on white, 0 to 100."""
    *rgb, alpha = to_rgba(colour)
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in rgb]
    light = alpha * float(np.dot((0.2126, 0.7152, 0.0722), linear)) + 1 - alpha
    return 116 * light ** (1 / 3) - 16 if light > 0.008856 else 903.3 * light


def alike_in_grey(figure: Figure) -> list[str]:
    """Return the pairs of entries of one legend that nothing but hue tells apart."""
    found = []
    for legend in _legends(figure):
        entries = [
            (text.get_text(), *_look(handle))
            for text, handle in zip(legend.get_texts(), legend.legend_handles, strict=True)
        ]
        for (one, shape, light), (other, shape2, light2) in combinations(entries, 2):
            if shape == shape2 and abs(light - light2) < LEAST_STEP:
                found.append(f"{one} and {other}: lightness {light:.0f} and {light2:.0f}")
    return found


def faint_neighbours(colours: list[Any], least: float) -> list[str]:
    """Return neighbours in a stack of colours whose lightness differs by less than `least`."""
    return [
        f"{one}, {other}"
        for one, other in pairwise(colours)
        if abs(lightness(one) - lightness(other)) < least
    ]


def overlaps(figure: Figure) -> list[str]:
    """Return the pairs of texts that cover one another, and the texts that leave the figure."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    # As of a Text: the extent of an annotation includes its arrow.
    shown = [(text.get_text(), Text.get_window_extent(text, renderer)) for text in _texts(figure)]
    found = [f"{one!r} and {other!r}" for (one, a), (other, b) in combinations(shown, 2) if _meet(a, b)]
    whole = figure.bbox
    for text, box in shown:
        inside = box.x0 >= whole.x0 - TOUCH and box.x1 <= whole.x1 + TOUCH
        if not (inside and box.y0 >= whole.y0 - TOUCH and box.y1 <= whole.y1 + TOUCH):
            found.append(f"{text!r} leaves the figure")
    return found


def covered(figure: Figure) -> list[str]:
    """Return the legends that cover lines, stacks or marks, and the bare texts that lines cross."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    found = []
    for axes in figure.axes:
        paths = [
            line.get_transform().transform_path(line.get_path())
            for line in axes.lines
            if line.get_linestyle() not in ("None", "") and line.get_visible()
        ]
        stacks = [
            collection.get_transform().transform_path(path)
            for collection in axes.collections
            if not len(collection.get_offsets()) or np.allclose(collection.get_offsets(), 0)
            for path in collection.get_paths()
        ]
        marks = [
            collection.get_offset_transform().transform(collection.get_offsets())
            for collection in axes.collections
            if len(collection.get_offsets()) > 1
        ]
        for legend in (item for item in axes.get_children() if isinstance(item, Legend)):
            box = Bbox.intersection(legend.get_window_extent(renderer), axes.get_window_extent(renderer))
            if box is None or box.width < TOUCH or box.height < TOUCH:
                continue
            words = f"legend of {axes.get_title() or axes.get_title('left')!r}"
            if any(path.intersects_bbox(box, filled=False) for path in paths):
                found.append(f"{words} covers a line")
            if any(path.intersects_bbox(box, filled=True) for path in stacks):
                found.append(f"{words} covers a stack")
            if any(_inside(points, box) for points in marks):
                found.append(f"{words} covers marks")
        for text in axes.texts:
            bare = text.get_bbox_patch() is None and not text.get_path_effects()
            box = Text.get_window_extent(text, renderer)
            if bare and text.get_text() and any(path.intersects_bbox(box, filled=False) for path in paths):
                found.append(f"a line crosses {text.get_text()!r}")
    return found


def share_of_figure(figure: Figure) -> float:
    """Return the share of the figure that panels fill, with their labels and titles."""
    renderer = FigureCanvasAgg(figure).get_renderer()
    boxes = [axes.get_tightbbox(renderer) for axes in figure.axes]
    # Counted on a grid of about a thousand cells, since labels of panels may share room.
    x, y = np.meshgrid(np.linspace(0, figure.bbox.width, 200), np.linspace(0, figure.bbox.height, 200))
    inside = np.zeros(x.shape, bool)
    for box in boxes:
        inside |= (x >= box.x0) & (x <= box.x1) & (y >= box.y0) & (y <= box.y1)
    return float(inside.mean())


def _parts(figure: Any) -> Iterator[Any]:
    """Yield a figure and its subfigures."""
    yield figure
    for part in figure.subfigs:
        yield from _parts(part)


def _legends(figure: Any) -> Iterator[Legend]:
    """Yield the legends of a figure, of its subfigures and of its panels."""
    for part in _parts(figure):
        yield from part.legends
    for axes in figure.axes:
        yield from (item for item in axes.get_children() if isinstance(item, Legend))


def _look(handle: Any) -> tuple[tuple[Any, ...], float]:
    """Return what tells an entry of a legend apart in grey: its shape, and its lightness."""
    if isinstance(handle, Line2D):
        inside = handle.get_markerfacecolor()
        hollow = inside == "none" or lightness(inside) > 95
        return ("line", handle.get_marker(), handle.get_linestyle(), hollow), lightness(handle.get_color())
    if hasattr(handle, "get_hatch") and not hasattr(handle, "get_offsets"):
        return ("patch", handle.get_hatch()), lightness(handle.get_facecolor())
    return ("marks", handle.get_paths()[0].vertices.round(3).tobytes()), lightness(handle.get_facecolor()[0])


def _texts(figure: Any) -> Iterator[Text]:
    """Yield the visible texts of a figure that are not empty; ticks only within their panel."""
    for axes in figure.axes:
        if not axes.get_visible():
            continue
        parts = [axes.title, axes._left_title, axes._right_title, *axes.texts]
        if axes.axison:
            for axis in (axes.xaxis, axes.yaxis):
                low, high = sorted(axis.get_view_interval())
                parts.append(axis.label)
                for tick in (*axis.get_major_ticks(), *axis.get_minor_ticks()):
                    if low <= tick.get_loc() <= high:
                        parts += [tick.label1, tick.label2]
        yield from (text for text in parts if text.get_visible() and text.get_text().strip())
    for part in _parts(figure):
        yield from (text for text in part.texts if text.get_visible() and text.get_text().strip())
    for legend in _legends(figure):
        yield from legend.get_texts()


def _meet(one: Bbox, other: Bbox) -> bool:
    """Return whether two boxes overlap by more than a touch."""
    width = min(one.x1, other.x1) - max(one.x0, other.x0)
    height = min(one.y1, other.y1) - max(one.y0, other.y0)
    return bool(width > TOUCH and height > TOUCH)


def _inside(points: Any, box: Bbox) -> bool:
    """Return whether any of points (k, 2) lies in a box."""
    points = np.asarray(points)
    x, y = points[:, 0], points[:, 1]
    return bool(((x > box.x0) & (x < box.x1) & (y > box.y0) & (y < box.y1)).any())
