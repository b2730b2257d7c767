"""The office with known stray points: `inspect --stray` counts them, and builds leave them out.

A user who walks through its door is stopped in the air as scanned, and passes with the proposed options.
"""

import contextlib
import io
import json
from pathlib import Path
from typing import Any, NamedTuple

import effect_rooms
import numpy as np
import pytest
import synthetic_scans
from effect_rooms import at, play
from numpy.typing import NDArray
from solidcloud.builder.plan.stray_points import find_stray_points
from solidcloud.builder.sources.scan_files import inspect_scans, open_scans
from solidcloud.builder.synthetic.office import CLEARANCE, WALL, solid_distances
from solidcloud.builder.synthetic.scanner import NOISE
from solidcloud.builder.synthetic.truth import OfficeTruth, read_office_truth
from solidcloud.schemas.scene.effect_table import Ground, Slide, Step, Stop, Sweep
from solidcloud.server.cli.main import run

# The walk: from the room, y > 0, through the door [m a frame].
BEGIN, PACE, FRAMES = (0.0, 1.0), 0.04, 50
# Half the depth of the user [m].
DEPTH = 0.2


class Office(NamedTuple):
    """The office, and what `inspect --stray --json` says of its scans. stray: (n,) of each scan."""

    folder: Path
    scans: list[NDArray[np.float64]]
    stray: list[NDArray[np.bool_]]
    truth: OfficeTruth
    said: list[dict[str, Any]]


@pytest.fixture(scope="module")
def office(tmp_path_factory: pytest.TempPathFactory) -> Office:
    """Make the office, and inspect it."""
    folder = tmp_path_factory.mktemp("office") / "office"
    assert run(["make", "office", "-o", str(folder)]) == 0
    truth = read_office_truth(folder.with_name("office.truth.json"))
    scans, stray = [], []
    for number, path in enumerate(sorted(folder.iterdir()), 1):
        (scan,) = open_scans(path)
        scans.append(np.concatenate([block.xyz for block in scan.blocks()]))
        stray.append(np.zeros(len(scans[-1]), np.bool_))
        for each in truth.strays:
            if each.station == number:
                stray[-1][each.first : each.first + each.count] = True
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert run(["inspect", str(folder), "--stray", "--json"]) == 0
    return Office(folder, scans, stray, truth, [each["stray"] for each in json.loads(printed.getvalue())])


def test_the_truth_names_the_strays_and_all_others_are_of_surfaces(office: Office) -> None:
    assert len(office.scans) == 2 and sum(map(len, office.scans)) == office.truth.points < 1_000_000
    assert {(each.kind, each.station) for each in office.truth.strays} == {
        ("dust", 1), ("dust", 2), ("person", 2),
    }  # fmt: skip
    for xyz, stray in zip(office.scans, office.stray, strict=True):
        away = solid_distances(xyz)
        assert away[stray].min() > CLEARANCE - 1e-3
        # The distance along an axis is within the noise of a range; the column counts as its box.
        flat = ~stray & (np.hypot(xyz[:, 0] - 1.9, xyz[:, 1] - 1.7) > 0.3)
        assert np.abs(away[flat]).max() < 6 * NOISE


def test_known_strays_are_counted_and_no_point_of_a_surface(office: Office, tmp_path: Path) -> None:
    known = [int(stray.sum()) for stray in office.stray]
    counted = [said["points"] for said in office.said]
    assert all(0.95 * n <= found <= n for n, found in zip(known, counted, strict=True)), (known, counted)
    without = [
        synthetic_scans.write_ply(tmp_path / f"{k}.ply", xyz[~stray])
        for k, (xyz, stray) in enumerate(zip(office.scans, office.stray, strict=True))
    ]
    assert [scan and scan.points for scan in find_stray_points(inspect_scans(without)).scans] == [0, 0]


def test_the_text_says_where_and_what_to_do(
    office: Office, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capsys.readouterr()
    assert run(["inspect", str(office.folder), "--stray", "-o", str(tmp_path / "scans.toml")]) == 0
    first, second, advice = capsys.readouterr().out.splitlines()[-3:]
    for line, said, number in ((first, office.said[0], 1), (second, office.said[1], 2)):
        assert line.startswith(f"{office.folder / f'station_000{number}.laz'}: {said['points']:,} points (")
        assert f"in {said['groups']:,} groups; the largest, of {said['largest']['points']}, at " in line
    assert advice.startswith(
        f"solidcloud build: --outliers {office.said[0]['outliers']} leaves out at least "
    )
    assert f"--moving {office.said[1]['moving']}" in advice
    # The person, in the door, was seen by the second scan only.
    assert np.abs(np.array(office.said[1]["largest"]["place"])[:2] - [0.0, -WALL / 2]).max() < 0.2


def walk(archive: Path) -> tuple[NDArray[np.float64], bool]:
    """Walk from the room towards the corridor; return the last place, and whether the user stood on floor."""
    with play(archive, Stop(), Sweep(), Slide(), Step(), Ground()) as game:
        body = game.body(effect_rooms.person(), at(*BEGIN, 0.05))
        for _ in range(FRAMES):
            moved = game.go(body, (0.0, -PACE, 0.0))
            assert not game.touches(body)
        assert moved.ground is not None
        return body.pose[:3, 3].copy(), moved.ground.on_ground


def stands_in_the_air(office: Office, place: NDArray[np.float64]) -> bool:
    """Return whether a stray, but no surface, is within 5 cm of a user's front."""
    xyz, stray = np.concatenate(office.scans), np.concatenate(office.stray)
    upright = (xyz[:, 2] > 0.1) & (xyz[:, 2] < 1.1)
    near = (np.abs(xyz[:, 0] - place[0]) < DEPTH + 0.05) & (np.abs(xyz[:, 1] - place[1]) < DEPTH + 0.05)
    return bool((near & upright & stray).any() and not (near & upright & ~stray).any())


@pytest.mark.slow
def test_the_door_is_passed_with_the_proposed_options_only(office: Office, tmp_path: Path) -> None:
    said = office.said[1]
    outliers, moving = ["--outliers", said["outliers"]], ["--moving", said["moving"]]
    for name, options, passes in (
        ("scanned", [], False),
        ("outliers", outliers, False),
        ("both", [*outliers, *moving], True),
    ):
        archive = tmp_path / name
        assert run(["build", str(office.folder), "-o", str(archive), "--jobs", "1", *options]) == 0
        place, on_ground = walk(archive)
        assert on_ground, name
        if passes:
            assert place[1] < -WALL - DEPTH, name
        else:
            assert place[1] > 0.0 and stands_in_the_air(office, place), (name, place)
