"""Test the accuracy report's page and charts: self-contained, every setting named, labels apart."""

import base64
import math
import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest
from picture_checks import alike_in_grey, covered, drawn_figures, overlaps, share_of_figure
from solidcloud.builder.config import BuildConfig
from solidcloud.server.report.accuracy.measurement.engine_settings import engine_settings, radius_settings
from solidcloud.server.report.accuracy.measurement.measurement_plan import BRIEF
from solidcloud.server.report.accuracy.measurement.setting_results import (
    RADIUS,
    SHEET,
    STEP,
    TOLERANCE,
    Report,
    Row,
    mark_pareto_fronts,
)
from solidcloud.server.report.accuracy.page import error_charts
from solidcloud.server.report.accuracy.page.chart_labels import place_labels
from solidcloud.server.report.accuracy.page.error_charts import draw_charts, points_of
from solidcloud.server.report.accuracy.page.html_page import table, write_page
from solidcloud.server.report.accuracy.page.page_texts import KNOBS, findings, leak_at
from solidcloud.server.report.common.sphere_pictures import load_pyplot

PLAIN_BUILD = BuildConfig(resolution=1e-4)
FACTS = {
    "warnings": ["A < B is not measured."],
    "avatar_points": 3617,
    "walk_poses": 1200,
    "judged_poses": 2400,
    "judged_contacts": 228,
    "near_tangent_poses": 400,
    "poses_judged_by_every_pair": 40,
}


def all_rows() -> list[Row]:
    """Return a row for each setting of a brief run, with random results except for the defaults."""
    rng = np.random.default_rng(5)
    settings = [*engine_settings(BRIEF, PLAIN_BUILD, 0.0124), *radius_settings(BRIEF, PLAIN_BUILD, 0.0124)]
    rows = [s.row for s in settings]
    for name, factor, door, leak in (
        ("mean", 1.0, -2.5, -11.6),
        ("mean:3", 3.0, 33.4, -21.0),
        ("border", 1.0, -10.0, -11.6),
        ("border:3", 3.0, 7.0, -20.0),
    ):
        rows.append(Row(SHEET, name, factor, name == "mean", doorway_mm=door, leak_p99_mm=leak))
    rows.sort(key=lambda row: list(KNOBS).index(row.knob))
    for row in (row for row in rows if row.knob != SHEET):
        scale = 1.0 if row.default else float(rng.uniform(0.9, 12))
        row.mean_us, row.p50_us, row.p99_us, row.times = 3.5 * scale, 3 * scale, 9 * scale, scale
        row.noise, row.poses, row.tangent = 1.0, 2400, 400
        row.early = 0 if row.default else int(rng.integers(0, 300))
        row.distance_max_mm, row.distance_mean_mm = 0.0, 0.0
        row.doorway_mm, row.leak_p99_mm = 24.0 * scale, 20.0 - scale
        row.archive_bytes, row.decode_ms = 2_492_304, 20.0
    mark_pareto_fronts(rows, (TOLERANCE, STEP, RADIUS))
    return rows


class Outside(HTMLParser):
    """Parser that collects everything that a page would fetch, and its text."""

    def __init__(self) -> None:
        super().__init__()
        self.fetched: list[str] = []
        self.text = ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            if (
                name in ("src", "href", "srcset", "data")
                and value
                and not value.startswith("data:image/png;base64,")
            ):
                self.fetched.append(f"{tag} {name}={value}")
        if tag in ("script", "link", "iframe", "object"):
            self.fetched.append(tag)

    def handle_data(self, data: str) -> None:
        self.text += data + "\n"


@pytest.fixture(scope="module")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Row], dict[str, Path]]:
    out = tmp_path_factory.mktemp("page")
    rows = all_rows()
    charts = draw_charts(rows, "made façade", out)
    write_page(Report("made façade", rows, FACTS), charts, out / "accuracy.html")
    return out, rows, charts


def test_the_page_fetches_nothing_and_names_every_knob_and_setting(
    drawn: tuple[Path, list[Row], dict[str, Path]],
) -> None:
    out, rows, charts = drawn
    page = (out / "accuracy.html").read_text(encoding="utf-8")
    parser = Outside()
    parser.feed(page)
    assert parser.fetched == [] and "url(" not in page and "@import" not in page
    for row in rows:
        assert row.setting in parser.text, row.setting
        assert row.knob.capitalize() in parser.text
    assert "<strong>A &lt; B is not measured.</strong></p>" in page
    assert "every pair of points in integers at 40 poses" in parser.text
    assert page.count("<img") == len(charts)
    for data in re.findall(r"data:image/png;base64,([^\"]+)", page):
        assert base64.b64decode(data).startswith(b"\x89PNG")


def test_every_chart_is_legible_in_grey_and_nothing_overlaps(tmp_path: Path) -> None:
    with drawn_figures() as figures:
        charts = draw_charts(all_rows(), "made façade", tmp_path)
    assert len(figures) == len(charts)
    for figure in figures:
        assert alike_in_grey(figure) == [] and overlaps(figure) == [] and covered(figure) == []
        assert share_of_figure(figure) > 0.75


def test_the_main_chart_is_small_enough_for_a_readme(
    drawn: tuple[Path, list[Row], dict[str, Path]],
) -> None:
    assert drawn[2]["main"].name == "accuracy.png"
    assert 10_000 < drawn[2]["main"].stat().st_size < 150_000


@pytest.mark.parametrize("errors", [("doorway", "leak"), ("wrong", "distance")])
def test_the_legend_lies_within_the_picture(
    errors: tuple[str, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figures = []
    monkeypatch.setattr(error_charts, "save_picture", lambda figure, target: figures.append(figure))
    error_charts.draw_scatter(all_rows(), errors, "façade", tmp_path / "accuracy.png")
    (figure,) = figures
    legend = figure.legends[0].get_window_extent()
    assert legend.x0 >= 0 and legend.x1 <= figure.bbox.width


def test_the_default_stands_once_in_a_chart() -> None:
    points = points_of(all_rows(), "doorway")
    assert [p.label for p in points].count("default") == 1
    assert len({p.label for p in points}) == len(points), "two points of one name"
    assert "tolerance 1 cm" in {p.label for p in points}
    models = [p.label for p in points if p.row.knob == RADIUS]
    assert models == ["local", "border", "local+border", "fixed:0.012"], "models without a factor"


def test_points_that_coincide_share_a_label_and_what_stops_a_ball_early_is_drawn_at_the_edge(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said: list[list[str]] = []
    monkeypatch.setattr(
        error_charts, "place_labels", lambda panel, anchors, labels, colours: said.append(list(labels))
    )
    rows = all_rows()
    for row in rows:
        if row.setting in ("tolerance 1 mm", "tolerance 2 mm", "tolerance 5 cm"):
            row.mean_us, row.doorway_mm, row.leak_p99_mm = 20.0, 30.0, -64.0 if "5 cm" in row.setting else 7.0
    error_charts.draw_scatter(rows, ("doorway", "leak"), "made façade", tmp_path / "chart.png")
    doors, walls, trade = said
    assert "tolerance 1 mm to 5 cm" in doors  # three at one place
    assert "tolerance 1 mm, 2 mm" in walls and "tolerance 5 cm: -64 mm" in walls
    assert any(label.startswith("default") for label in walls) and any("mean, default" in t for t in trade)
    for model in ("mean:0.5", "local", "border:2", "local+border", "fixed:0.025"):
        assert sum(model in label.split("\n") for label in trade) == 1, model


def test_columns_that_nobody_filled_are_left_out_and_a_door_nobody_passes_is_said() -> None:
    rows = [
        Row(TOLERANCE, "0", default=True, mean_us=1.0, poses=5, doorway_mm=3.0),
        Row(TOLERANCE, "10 cm", poses=5),
    ]
    rows[1].doorway_mm, rows[1].early = float("inf"), 2
    html = table(rows)
    assert "does not pass" in html and "2 of 5" in html and "(default)" in html
    assert "note" not in html
    rows[1].note = "cannot stand"
    assert "<th>note</th>" in table(rows) and "<td>cannot stand</td>" in table(rows)
    assert "decode" not in html and "made doorway" not in html and "near-tangent" not in html
    rows[0].made_doorway_mm = 12.34
    assert "<th>made doorway [mm]</th>" in table(rows) and "<td>12.3</td>" in table(rows)


def test_the_findings_follow_from_the_rows() -> None:
    rows = all_rows()
    slow = " ".join(findings(rows))
    assert "it is not measurably faster" in slow
    for row in rows:
        if row.setting == "tolerance 5 cm":
            row.times, row.early = 0.5, 77
    fast = " ".join(findings(rows))
    assert "not measurably faster" not in fast
    assert "tolerance 5 cm, a pose takes 0.50 times the time of the exact" in fast
    assert "and 77 of 2,400 poses are called early" in fast
    assert "doors of decreasing width" not in fast, "no doors were made"
    next(row for row in rows if row.setting == "local").made_doorway_mm = 31.2
    assert "doors of decreasing width: local 31 mm (inferred" in " ".join(findings(rows))
    assert "at 3 times the mean radius 33 mm with mean, 7 mm with border, leaks (p99) -21 and -20 mm" in fast
    assert (
        "at 1 times the mean radius -2 mm with mean, -10 mm with border, leaks (p99) -12 and -12 mm" in fast
    )
    assert "border makes this door 10 mm wider than it is" in fast
    next(row for row in rows if row.knob == SHEET and row.setting == "border").doorway_mm = 1.0
    assert "wider than it is" not in " ".join(findings(rows))
    assert findings([]) == []
    assert "Check: " not in fast
    assert findings(rows, 40)[0].endswith("every pair of points in integers at 40 poses agrees with it.")


def test_times_within_noise_are_not_told_apart() -> None:
    rows = [Row(TOLERANCE, "0", default=True, mean_us=1.0, p99_us=2.0, times=1.0)]
    search = Row(TOLERANCE, "tolerance 5 cm", poses=9)
    rows += [search]
    for times, noise, said, won in (
        (1.14, 1.0, "the same time as the exact answer, within noise", False),
        (0.88, 1.0, "the same time as the exact answer, within noise", False),
        (1.16, 1.0, "1.16 times the time of the exact", False),
        (0.50, 1.0, "0.50 times the time of the exact", True),
        (0.50, 1.5, "a time too noisy to compare with the exact answer", False),
    ):
        search.times, search.noise = times, noise
        found = findings(rows)[1]
        assert found.count(said) == 1, found
        assert ("it is not measurably faster" in found) != won


def felt(setting: str, doorway: float, leak: float) -> Row:
    return Row(RADIUS, setting, default=setting == "mean", doorway_mm=doorway, leak_p99_mm=leak)


def test_radius_models_are_compared_at_the_same_doorway_error() -> None:
    mean = felt("mean", 26.0, 16.0)
    rows = [felt("local:2", 50.0, -4.0), mean, felt("local:0.5", 12.0, 28.0), felt("local", 24.0, 14.0)]
    rows += [felt("local+border", 26.0, 1.0), felt("local:0.1", math.inf, 0.0)]
    assert leak_at(rows, "local", 26.0) == pytest.approx(14.0 - 18.0 * 2 / 26)
    assert leak_at(rows, "local", 24.0) == 14.0 and leak_at(rows, "local", 50.0) == -4.0
    assert leak_at(rows, "local", 11.9) is leak_at(rows, "local", 50.1) is leak_at(rows, "mean", 27.0) is None
    said = " ".join(findings(rows))
    assert (
        "mean (26 mm) local leaks 13 mm at p99 against 16 mm" in said and "more than half. The effect" in said
    )
    mean.leak_p99_mm = 26.0
    assert "local leaks 13 mm at p99 against 26 mm" in (said := " ".join(findings(rows)))
    assert "half or less" in said and "random gaps" not in said
    mean.leak_p99_mm = 12.0
    assert "no gain" in " ".join(findings(rows))
    mean.doorway_mm = 11.0
    assert "At the doorway error" not in " ".join(findings(rows)), (
        "no factor of local reaches so narrow a door"
    )
    for row in rows:
        row.doorway_mm = None
    assert findings(rows) == [
        "Radius models, 99th percentile of the leak: mean 12 mm; local 14 mm; local+border 1 mm."
    ]


def test_labels_cover_neither_one_another_nor_points() -> None:
    pyplot = load_pyplot()
    figure, panel = pyplot.subplots(figsize=(7, 6))
    rng = np.random.default_rng(3)
    anchors = [(float(x), float(y)) for x, y in rng.uniform(0.2, 0.8, (12, 2))]
    panel.set_xlim(0, 1)
    panel.set_ylim(0, 1)
    figure.canvas.draw()
    place_labels(panel, anchors, [f"setting {k}" for k in range(12)], ["black"] * 12)
    renderer = figure.canvas.get_renderer()
    boxes = [text.get_window_extent(renderer) for text in panel.texts]
    assert len(boxes) == 12
    for i, one in enumerate(boxes):
        assert not any(one.overlaps(other) for other in boxes[i + 1 :]), panel.texts[i].get_text()
        for spot in panel.transData.transform(anchors):
            assert not one.contains(*spot), panel.texts[i].get_text()
    pyplot.close(figure)
