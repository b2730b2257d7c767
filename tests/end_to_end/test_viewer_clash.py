"""Test the clash check of the viewer with a real browser, on a path through walls of the façade."""

import io
import itertools
import json
import math
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.cli.input.pose_file import read_path
from solidcloud.server.client import Client
from solidcloud.server.viewer.users.user_avatar import figure_avatar
from solidcloud.server.viewer.viewer import viewing
from viewed_page import DEADLINE, ViewedPage, needs_chromium, viewed_page

pytestmark = [needs_chromium, pytest.mark.slow]

SCENE = "archive"
# The user stands far from the clashes: what is seen of them is seen by the jump.
AT = "4,-9,0.1,90"
WAY = [(2.6, -3.0, 0.7), (2.6, 3.0, 0.7), (-6.0, 3.0, 0.7), (-6.0, -9.0, 0.7), (-10.5, -9.0, 0.7)]


@pytest.fixture(scope="module")
def path_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trajectory in the TUM format, 10 poses a second, 10 cm apart."""
    rows, time = ["# time tx ty tz qx qy qz qw"], 100.0
    for begin, end in itertools.pairwise(WAY):
        count = round(math.dist(begin, end) / 0.1)
        yaw = math.atan2(end[1] - begin[1], end[0] - begin[0]) - math.pi / 2
        for step in range(count):
            x, y, z = (a + (b - a) * step / count for a, b in zip(begin, end, strict=True))
            rows.append(f"{time:.1f} {x:.4f} {y:.4f} {z} 0 0 {math.sin(yaw / 2)!r} {math.cos(yaw / 2)!r}")
            time += 0.1
    path = tmp_path_factory.mktemp("path") / "tour.tum"
    path.write_text("\n".join(rows) + "\n", encoding="ascii")
    return path


@pytest.fixture(scope="module")
def expected(facade_endpoint: str, path_file: Path) -> list[tuple[float, int, int, int]]:
    """Return depth, first and last pose, and contacts of each clash, as `contacts` of every pose finds them."""
    avatar = figure_avatar()
    _, poses = read_path(path_file)
    with Client(facade_endpoint, scene=SCENE) as client:
        client.add_avatar("judge", avatar.points, avatar.radius)
        # One at a time: a server ends requests that take long.
        answers = [client.contacts("judge", pose) for pose in poses]
    clashes: list[tuple[float, int, int, int]] = []
    for pose, found in enumerate(answers):
        assert found.verdict[0] != Verdict.UNKNOWN
        if found.verdict[0] != Verdict.CONTACT:
            continue
        depth, pairs = -float(found.signed_distance.min()), int(found.pairs_found[0])
        if clashes and clashes[-1][2] == pose - 1:
            before = clashes.pop()
            clashes.append((max(before[0], depth), before[1], pose, max(before[3], pairs)))
        else:
            clashes.append((depth, pose, pose, pairs))
    return sorted(clashes, key=lambda each: (-each[0], each[1]))


def load(viewed: ViewedPage, file: Any) -> Any:
    """Load a path, and return what the page knows of its check when it has ended."""
    viewed.page.get_by_label("Load a path").set_input_files(file)
    viewed.wait("s.clash.state !== 'none'")
    return viewed.wait("['done', 'failed'].includes(s.clash.state) && s.clash")


def saved(viewed: ViewedPage, button: str) -> tuple[str, bytes]:
    """Return the name and the content of a file that a button saves."""
    with viewed.page.expect_download(timeout=1000 * DEADLINE) as download:
        viewed.page.get_by_role("button", name=button, exact=True).click()
    return download.value.suggested_filename, Path(download.value.path()).read_bytes()


def test_list_jumps_and_files_are_the_clashes_that_contacts_finds(
    browser: Any, facade_endpoint: str, path_file: Path, expected: list[tuple[float, int, int, int]]
) -> None:
    assert len(expected) >= 3
    with viewing(facade_endpoint) as url, viewed_page(browser, f"{url}?at={AT}") as viewed:
        viewed.wait_complete()
        before, user = viewed.picture(), viewed.read("s.camera")
        clash = load(viewed, path_file)
        listed = clash["result"]["clashes"]
        assert [(each["depth"], *each["poses"], each["contacts"]) for each in listed] == [
            (pytest.approx(depth, abs=1e-9), *rest) for depth, *rest in expected
        ]
        poses = clash["result"]["poses"]
        touching = sum(last - first + 1 for _, first, last, _ in expected)
        # Classes: contact, unknown, near, clear, not examined.
        assert clash["classes"][0] == touching
        assert sum(clash["classes"]) == poses
        assert clash["classes"][4] == 0
        buttons = viewed.page.locator("#clash-list button")
        assert buttons.count() == len(expected)
        assert buttons.first.inner_text().startswith(f"1. {100 * expected[0][0]:.1f} cm deep")
        # A near distance of another length colours the path anew.
        viewed.page.get_by_label("Near", exact=True).focus()
        viewed.page.keyboard.press("End")
        viewed.wait("s.clash.classes[3] === 0 && s.clash.classes[2] > 0")

        buttons.first.click()
        shown = viewed.wait("s.watching && s.clash.shown")
        camera = viewed.read("s.camera")
        assert math.dist(camera, user) > 2
        assert np.allclose(camera, shown["eye"], atol=1e-3)
        assert viewed.read("s.clash.ghost.body")
        assert viewed.read("s.clash.ghost.places") == min(
            60, expected_pairs(facade_endpoint, path_file, listed[0])
        )
        assert viewed.read("s.clash.ghost.normals") >= 1
        viewed.wait("s.complete")
        # The ghost and the contacts: light grey, and red.
        picture = viewed.picture()
        red, green, blue = np.moveaxis(picture, -1, 0)
        assert ((red > 200) & (green < 120) & (blue < 120)).sum() > 40
        assert np.abs(picture - before).max() > 60

        viewed.page.keyboard.press(".")
        viewed.wait("s.clash.shown.number === 2")
        assert math.dist(viewed.read("s.camera"), camera) > 0.5
        viewed.page.keyboard.press(",")
        viewed.wait("s.clash.shown.number === 1")
        buttons.nth(2).focus()
        viewed.page.keyboard.press("Enter")
        viewed.wait("s.clash.shown.number === 3")
        assert buttons.nth(2).get_attribute("aria-current") == "true"
        viewed.page.keyboard.press("Escape")
        viewed.wait("!s.watching")
        viewed.wait("s.camera", lambda place: math.dist(place, user) < 0.2)
        assert not viewed.read("s.clash.ghost.body")

        check_files(viewed, listed)
        viewed.check_clean(url)


def expected_pairs(facade_endpoint: str, path_file: Path, clash: dict[str, Any]) -> int:
    """Return how many pairs are in contact at the deepest pose of a clash."""
    avatar = figure_avatar()
    pose = read_path(path_file)[1][clash["pose_deepest"]]
    with Client(facade_endpoint, scene=SCENE) as client:
        client.add_avatar("judge", avatar.points, avatar.radius)
        return int(client.contacts("judge", pose, limit=0).pairs_found[0])


def check_files(viewed: ViewedPage, listed: list[dict[str, Any]]) -> None:
    """Save every kind of file, and check that it agrees with the list."""
    name, content = saved(viewed, "CSV")
    assert name == "tour-clashes.csv"
    header, *rows = content.decode().splitlines()
    assert header.startswith("clash,depth_m,x,y,z,")
    assert [float(row.split(",")[1]) for row in rows] == [each["depth"] for each in listed]
    name, content = saved(viewed, "JSON")
    assert name == "tour-clashes.json"
    found = json.loads(content)
    assert found["about"]["path"] == "tour.tum"
    assert found["clashes"] == [{key: value for key, value in each.items() if key != "at"} for each in listed]
    name, content = saved(viewed, "BCF 2.1")
    assert name == "tour-clashes.bcf"
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        names = archive.namelist()
        assert names[0] == "bcf.version"
        assert len(names) == 1 + 3 * len(listed)
        for snapshot in (each for each in names if each.endswith("snapshot.png")):
            picture = np.asarray(Image.open(io.BytesIO(archive.read(snapshot)))).astype(int)
            assert picture.shape == (540, 960, 3)
            red, green, _ = np.moveaxis(picture, -1, 0)
            assert ((red > 200) & (green < 120)).any()
    name, content = saved(viewed, "Save the view as PNG")
    assert name == f"{SCENE}.png"
    picture = np.asarray(Image.open(io.BytesIO(content)).convert("RGB"))
    assert len(np.unique(picture.reshape(-1, 3), axis=0)) > 100


def test_path_of_the_command_line_is_checked_at_once(
    browser: Any, facade_endpoint: str, path_file: Path, expected: list[tuple[float, int, int, int]]
) -> None:
    with viewing(facade_endpoint, poses=path_file) as url, viewed_page(browser, url) as viewed:
        result = viewed.wait("s.clash.state === 'done' && s.clash.result")
        assert [each["poses"] for each in result["clashes"]] == [[each[1], each[2]] for each in expected]
        assert f"tour.tum: {len(expected)} clashes." in viewed.page.inner_text("#clash-message")
        viewed.check_clean(url)


def test_wall_between_two_poses_is_listed_and_shown(browser: Any, facade_endpoint: str) -> None:
    """Issue 35: the page said "No clash" of a path whose poses lie before and behind a wall."""
    content = b"t,x,y,z,qw,qx,qy,qz\n0,2.6,-3,0.7,1,0,0,0\n2,2.6,3,0.7,1,0,0,0\n"
    with viewing(facade_endpoint) as url, viewed_page(browser, f"{url}?at={AT}") as viewed:
        viewed.wait_complete()
        clash = load(viewed, {"name": "wall.csv", "mimeType": "text/csv", "buffer": content})
        result = clash["result"]
        assert (result["counts"]["contact"], result["motions"]["contact"]) == (0, 1)
        assert result["total"] == result["between"] >= 1
        assert "between poses" in viewed.page.inner_text("#clash-message")
        button = viewed.page.locator("#clash-list button").first
        assert "between pose 0 and 1" in button.inner_text()
        button.click()
        shown = viewed.wait("s.watching && s.clash.shown")
        fraction = result["clashes"][0]["pose_deepest"]
        assert 0 < result["clashes"][0]["fraction"] <= fraction < 1
        assert shown["pose"] != [[1, 0, 0, 2.6], [0, 1, 0, -3], [0, 0, 1, 0.7], [0, 0, 0, 1]]
        assert viewed.read("s.clash.ghost.places") >= 1
        _, content = saved(viewed, "BCF 2.1")
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            texts = [archive.read(name).decode() for name in archive.namelist() if name.endswith(".bcf")]
        assert "between pose 0 and 1" in texts[0]
        viewed.check_clean(url)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("a.csv", "t,x,y,z\n", "a.csv, line 1: columns t,x,y,z: expected t,x,y,z,qw,qx,qy,qz"),
        (
            "a.csv",
            "t,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n1,0,0,zero,1,0,0,0\n",
            "a.csv, line 3: could not convert string to float: 'zero': expected numbers",
        ),
        ("a.csv", "t,x,y,z,qw,qx,qy,qz\n", "the path has no poses: expected at least one"),
        ("b.tum", "# walk\n1 2 3\n", "b.tum, line 2: 3 values: expected timestamp tx ty tz qx qy qz qw"),
        ("b.txt", "0 0 0 0 0 0 0 2\n", "b.txt, line 1: quaternion of length 2: expected 1 within 0.001"),
        ("c.csv", "\x00\ud83d" * 9000, "c.csv, line 1: columns"),
    ],
)
def test_malformed_file_is_named_on_the_page(
    browser: Any, facade_endpoint: str, path_file: Path, name: str, text: str, said: str
) -> None:
    with viewing(facade_endpoint) as url, viewed_page(browser, url) as viewed:
        viewed.wait("s.server === 'connected'")
        content = text.encode("utf-8", "surrogatepass")
        clash = load(viewed, {"name": name, "mimeType": "text/plain", "buffer": content})
        assert clash["state"] == "failed"
        assert said in viewed.page.inner_text("#clash-message")
        # The next file is checked.
        viewed.page.get_by_label("Load a path").set_input_files(path_file)
        viewed.wait("s.clash.state === 'done'")
        assert viewed.read("s.clash.message") == ""
        viewed.check_clean(url)


def test_cancelled_check_lists_what_was_found(browser: Any, facade_endpoint: str, path_file: Path) -> None:
    _, *rows = path_file.read_text().splitlines()
    # Longer than any machine checks before the button is pressed.
    content = "\n".join(rows * (60_000 // len(rows))).encode()
    with viewing(facade_endpoint) as url, viewed_page(browser, url) as viewed:
        viewed.wait("s.server === 'connected'")
        file = {"name": "long.tum", "mimeType": "text/plain", "buffer": content}
        viewed.page.get_by_label("Load a path").set_input_files(file)
        # Some poses have an answer, and others do not.
        viewed.wait("s.clash.state === 'running' && s.clash.classes[0] > 0 && s.clash.classes[4] > 0")
        # A page that draws one picture a second is never still enough for a click.
        viewed.page.get_by_role("button", name="Cancel").dispatch_event("click")
        result = viewed.wait("s.clash.state === 'done' && s.clash.result")
        assert not result["complete"]
        assert result["counts"]["unknown"] > 0
        assert "Cancelled: the rest was not examined" in viewed.page.inner_text("#clash-message")
        assert viewed.read("s.clash.classes[4]") == result["counts"]["unknown"]
        viewed.check_clean(url)
