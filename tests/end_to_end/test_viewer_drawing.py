"""Test that the page's own drawing looks as WebGL's: where graphics are computed in software, it replaces it.

The page draws a façade in every colour twice, and the pictures are compared in blocks of pixels: points
are squares in one and discs in the other, so single pixels differ.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.synthetic.scenes import make_facade
from solidcloud.server.cli.scene_files.viewed_scene import archive_scene
from solidcloud.server.report.walk.server_process import served
from solidcloud.server.viewer.viewer import viewing
from viewed_page import ViewedPage, coloured, needs_chromium, viewed_page

pytestmark = [needs_chromium, pytest.mark.slow]

POINTS = 150_000
BEFORE_DOOR, BY_WALL = "0,-6,0.1,90", "-7.6,-9,0.1,180"
COLOURS = ("height", "rgb", "intensity", "classification", "scan", "verdict")
# Blocks of pixels that are compared, and by how much most of them and all together may differ, of 255.
BLOCK, MOST, TOGETHER = 23, 8.0, 2.5
# Shares of pixels and points that may differ between the two inner loops: one computes in float32.
ROUNDED, ROUNDED_POINTS = 0.01, 0.001
# Draws the same points with both loops: [share of coloured pixels, of different ones, points inside twice].
BOTH_LOOPS = """async ([size, cutting]) => {
  const { Kernel } = await import("/raster/kernel.js"), { fogTables, splat } = await import("/raster/splats.js");
  const [width, height, count, ground] = [320, 200, 40000, 0xff150e0a], pixels = width * height;
  const kernel = await Kernel.made(), arrays = kernel.resize(width, height), fog = fogTables([0.04, 0.05, 0.08]);
  const one = { width, height, depth: new Float32Array(pixels), colour: new Uint32Array(pixels).fill(ground) };
  const other = new Uint32Array(arrays.colours.buffer, arrays.colours.byteOffset, pixels).fill(ground);
  arrays.depth.fill(0);
  let state = 2012;
  const next = () => (state = (Math.imul(state, 1664525) + 1013904223) >>> 0);
  const places = Uint16Array.from({ length: 3 * count }, () => next() >>> 16);
  const colours = Uint32Array.from({ length: count }, () => 0xff000000 | (next() >>> 8));
  // A cube of 8 m; the camera is in it, and looks along y.
  const step = 8 / 65536, eye = [4, 1, 3].map((at) => at / step), scale = 160 * step;
  const row = (x, y, z) => [x, y, z, -(x * eye[0] + y * eye[1] + z * eye[2])];
  const screen = [...row(scale, 160 * step, 0), ...row(0, 100 * step, -scale), ...row(0, step, 0)];
  const cut = cutting ? [0, step, 0, step * step, 3, 0.9, 0.2] : [0, 0, 0, 0, -1, 0, 0];
  const rest = [3, count, screen, size, 1.6, 40, 0.05, [...eye, (step / 20) ** 2], fog, cut];
  const inside = [splat(one, places, colours, ...rest), kernel.splat(places, colours, ...rest)];
  const share = (of) => one.colour.reduce((sum, each, k) => sum + of(each, k), 0) / pixels;
  return [share((each) => each !== ground), share((each, k) => each !== other[k]), ...inside];
}"""
# Shares of coloured pixels may differ by this much: a small square is larger than a small disc.
SHARE = 0.02


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An archive of two scans with all columns."""
    folder = tmp_path_factory.mktemp("drawing")
    made = make_facade(folder / "facade.las", points=POINTS)
    scan = laspy.read(made.paths[0])
    x, y, z = (np.asarray(axis) for axis in (scan.x, scan.y, scan.z))
    scans = folder / "scans"
    scans.mkdir()
    for number, part in enumerate((x < 0, x >= 0)):
        header = laspy.LasHeader(point_format=7, version="1.4")
        header.offsets, header.scales = scan.header.offsets, scan.header.scales
        coloured_scan = laspy.LasData(header)
        coloured_scan.x, coloured_scan.y, coloured_scan.z = x[part], y[part], z[part]
        height, along = (np.clip(axis[part] / 10, 0, 1) * 65535 for axis in (z, np.abs(y)))
        coloured_scan.red, coloured_scan.green, coloured_scan.blue = height, along, 65535 - height
        coloured_scan.intensity = np.asarray(scan.intensity)[part]
        coloured_scan.classification = np.where(z[part] < 0.5, 2, 6)
        coloured_scan.write(scans / f"{number}.las")
    keep = frozenset({"scan", "intensity", "rgb", "classification"})
    build_archive([scans], folder / "archive", BuildConfig(voxel=2.0, jobs=1, keep=keep))
    (folder / "drawing.toml").write_text(archive_scene(folder / "archive"))
    return folder / "drawing.toml"


@pytest.fixture(scope="module")
def url(archive: Path) -> Iterator[str]:
    with served(archive, None) as endpoint, viewing(endpoint) as url:
        yield url


def test_scan_looks_the_same_in_every_colour(browser: Any, url: str) -> None:
    own, webgl = (pictures(browser, f"{url}?at={BEFORE_DOOR}{way}") for way in ("", "&drawing=webgl"))
    for name in COLOURS:
        assert coloured(own[name]) > 0.15
        check_similar(own[name], webgl[name], name)
    # The colours themselves differ: no comparison is of twice the same.
    assert all(np.abs(own["height"] - own[name]).mean() > 3 for name in COLOURS[1:])


def test_shading_contacts_and_voxels_look_the_same(browser: Any, url: str) -> None:
    found = []
    for way in ("", "&drawing=webgl"):
        with viewed_page(browser, f"{url}?at={BY_WALL}{way}") as viewed:
            assert viewed.read("s.drawing.parts !== undefined") == (way == "")
            viewed.page.get_by_label("Shading by depth").check()
            viewed.page.get_by_label("Voxels in memory").check()
            viewed.wait("s.place && s.boxes")
            viewed.wait_complete()
            found.append(settled(viewed))
            viewed.check_clean(url)
    check_similar(*found, "shaded")


def test_what_only_webgl_draws_is_over_the_own_picture(browser: Any, url: str) -> None:
    with viewed_page(browser, f"{url}?at={BEFORE_DOOR}") as viewed:
        viewed.wait_complete()
        before = viewed.picture()
        viewed.page.keyboard.press("g")
        viewed.page.get_by_text("Hierarchy", exact=True).click()
        viewed.wait("s.spheres && s.spheres.drawn > 0")
        viewed.wait("s.drawing.canvas === 'webgl'")
        viewed.page.keyboard.press("g")
        viewed.wait("s.drawing.canvas === 'own'")
        viewed.wait_complete()
        check_similar(viewed.picture(), before, "after spheres")
        viewed.check_clean(url)


@pytest.mark.parametrize("cut", [False, True])
@pytest.mark.parametrize("size", [4, 12, 25, 60, 400])
def test_both_inner_loops_draw_the_same(browser: Any, url: str, size: float, cut: bool) -> None:
    with viewed_page(browser, url) as viewed:
        filled, different, one, other = viewed.page.evaluate(BOTH_LOOPS, [size, cut])
    assert filled > 0.3
    assert different < ROUNDED
    assert one > 1000 and abs(one - other) <= ROUNDED_POINTS * one


def test_a_browser_without_webassembly_draws_the_same(browser: Any, url: str) -> None:
    found = []
    for before, loop in (("", "wasm"), ("delete window.WebAssembly", "js")):
        with viewed_page(browser, f"{url}?at={BEFORE_DOOR}", before=before) as viewed:
            viewed.wait_complete()
            viewed.wait(f"s.drawing.loop === '{loop}'")
            found.append(settled(viewed))
            viewed.check_clean(url)
    check_similar(*found, "without WebAssembly")


def pictures(browser: Any, address: str) -> dict[str, np.ndarray]:
    """Return the picture in each colour."""
    found = {}
    with viewed_page(browser, address) as viewed:
        viewed.wait_complete()
        for name in COLOURS:
            viewed.page.get_by_label("Colour of the scan").select_option(name)
            viewed.wait("s.colour", lambda colour, name=name: colour == name)
            found[name] = settled(viewed)
    return found


def settled(viewed: ViewedPage) -> np.ndarray:
    """Return the picture as soon as two in a row are the same."""
    before = viewed.picture()
    while True:
        viewed.page.wait_for_timeout(300)
        now = viewed.picture()
        if np.array_equal(before, now):
            return now
        before = now


def check_similar(one: np.ndarray, other: np.ndarray, what: str) -> None:
    """Check that two pictures agree in their blocks."""
    assert abs(coloured(one) - coloured(other)) < SHARE, (what, coloured(one), coloured(other))
    difference = np.abs(blocks(one) - blocks(other))
    assert difference.mean() < TOGETHER, (what, difference.mean())
    assert np.quantile(difference, 0.95) < MOST, (what, np.quantile(difference, 0.95))


def blocks(picture: np.ndarray) -> np.ndarray:
    """Return the mean colours (r, c, 3) of square blocks."""
    height, width = (size - size % BLOCK for size in picture.shape[:2])
    parts = picture[:height, :width].reshape(height // BLOCK, BLOCK, width // BLOCK, BLOCK, 3)
    return np.asarray(parts.mean(axis=(1, 3)))
