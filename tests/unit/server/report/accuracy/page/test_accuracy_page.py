"""Test the accuracy report's page, charts and sentences, with results that are made up."""

import base64
import re
from html.parser import HTMLParser
from pathlib import Path

from solidcloud.server.report.accuracy.measurement.accuracy_results import (
    ColdRow,
    FieldRow,
    FrameRow,
    MemoryRow,
    RadiusRow,
    Report,
    WalkRow,
)
from solidcloud.server.report.accuracy.measurement.pose_classes import CLASSES
from solidcloud.server.report.accuracy.page.accuracy_charts import draw_charts
from solidcloud.server.report.accuracy.page.accuracy_page import write_page
from solidcloud.server.report.accuracy.page.accuracy_texts import answer

FACTS = {
    "scene": "generated <façade>",
    "warnings": ["A < B is not measured."],
    "avatar_points": 3617,
    "judged_poses": 2400,
    "judged_contacts": 228,
    "decoded_bytes": 5_092_520,
    "processor": "a processor",
    "poses_judged_by_every_pair": 40,
}
TOLERANCES = (0.0, 0.001, 0.003, 0.01, 0.03, 0.1, 0.3)
MODELS = (("mean", 0.0), ("local", 1.5), ("border", 0.2), ("local+border", 1.7), ("fixed", 0.5))


def memory_rows() -> list[MemoryRow]:
    """Return rows of all classes but the last: nearer ones are faster with larger tolerances."""
    rows = []
    for number, kind in enumerate(list(CLASSES)[:4]):
        for question, base in (("collide", 3.0 - 0.5 * number), ("distance", 12.0 - 2 * number)):
            for at, tolerance in enumerate(TOLERANCES):
                ratio = 1.0 - 0.08 * at if number < 2 else 1.0
                error = None if question == "collide" else 900 * tolerance
                interval = (ratio, ratio - 0.02, ratio + 0.02, at != 2 or number > 0)
                early, visits = 0.1 * at, 500.0 - 10 * at
                rows.append(
                    MemoryRow(question, kind, 0.25, tolerance, base * ratio, *interval, early, error, visits)
                )
    return rows


def report() -> Report:
    """Return a report of a façade with all its parts."""
    fields = [
        FieldRow(cell, kind, 0.1, 5.0 + at, 2.0 + at, 0.01, 0.3, 0.9, 48_000_000, int(3.2e4 / cell**3), 2.5)
        for cell in (0.02, 0.05, 0.1)
        for at, kind in enumerate(list(CLASSES)[:4])
    ]
    cold = [
        ColdRow(None, 200.0, 1.0, 1.0, 1.0, 4e6, 1.0, 1.0, 1.0, 1.0),
        ColdRow(0.0, 30.0, 0.15, 0.1, 0.2, 6e5, 0.15, 0.1, 0.2, 0.2),
        ColdRow(0.1, 5.0, 0.025, 0.02, 0.03, 5e4, 0.0125, 0.01, 0.02, 0.0),
    ]
    walks = [
        WalkRow(0.1, 509_252, "exact", "", 900, 45, 120.0, 0.2, 10**8, 0.0, 0),
        WalkRow(0.1, 509_252, "bounds", "", 900, 0, 5.0, 0.2, 10**6, 0.15, 0),
        WalkRow(0.001, 5092, "exact", "the largest voxel does not fit"),
        WalkRow(0.001, 5092, "bounds", "", 900, 0, 6.0, 0.3, 10**6, 0.16, 0),
    ]
    radii = []
    for model, shift in MODELS:
        for factor in (0.5, 1.0, 2.0):
            name, leak = model if factor == 1 else f"{model}:{factor:g}", 20.0 - 10 * factor - 2 * shift
            door, passed = 26.0 * factor - shift, 0.002 / factor
            radii.append(
                RadiusRow("façade", model, name, factor, 2.0 + shift, door, None, -5.0, leak, 100.0, passed)
            )
    inf = float("inf")
    radii.append(RadiusRow("sheet", "mean", "mean:3", 3.0, None, inf, None, -25.0, -21.0, -19.0, 0.0))
    frames = [
        FrameRow(tolerance, 180.0 - 20 * at, 900.0, 1.0 - 0.1 * at, 0.9, 1.1, at != 1, 27.0, 1e3 * tolerance)
        for at, tolerance in enumerate((1e-5, 1e-4, 1e-3, 1e-2, 1e-1))
    ]
    return Report(FACTS, memory_rows(), fields, cold, walks, radii, frames)


class Outside(HTMLParser):
    """Parser that collects everything that a page would fetch, and its text."""

    def __init__(self) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            own = value and value.startswith("data:image/png;base64,")
            if name in ("src", "href", "srcset", "data") and value and not own:
                self.fetched.append(f"{tag} {name}={value}")
        if tag in ("script", "link", "iframe", "object"):
            self.fetched.append(tag)

    def handle_data(self, data: str) -> None:
        self.text += data + "\n"


def test_the_page_begins_with_the_answer_fetches_nothing_and_holds_every_result(tmp_path: Path) -> None:
    made = report()
    charts = draw_charts(made, tmp_path)
    write_page(made, charts, tmp_path / "accuracy.html")
    page = (tmp_path / "accuracy.html").read_text(encoding="utf-8")
    parser = Outside()
    parser.feed(page)
    assert parser.fetched == [] and "url(" not in page and "@import" not in page
    assert "{" not in page.partition("</style>")[2], "a value that was not formatted"
    text = parser.text
    assert 0 < text.index(answer(made)) < text.index("Three settings") < text.index("1. In memory")
    titles = ("In memory", "With nothing in memory", "A walk with", "Radius", "Frames")
    for number, title in enumerate(titles, 1):
        assert f"{number}. {title}" in text
    for word in (*list(CLASSES)[:4], "local+border:0.5", "does not pass", "the largest voxel does not fit"):
        assert word in text
    assert "A < B is not measured." in text and "generated <façade>" in text
    assert page.count("<img") == len(charts) == 7
    for data in re.findall(r"data:image/png;base64,([^\"]+)", page):
        assert base64.b64decode(data).startswith(b"\x89PNG")
