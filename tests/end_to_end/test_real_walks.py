"""Test walks through real scans: through doors, against their jambs and along walls.

The scans lie in the folder that SOLIDCLOUD_SCANS names; without it, the tests are skipped. The
routes, and what is measured, are those of scripts/walk_scans.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from walk_scans_cases.measured_walks import MeasuredWalk, measure_walk, scan_points, write_scene
from walk_scans_cases.persons import make_person
from walk_scans_cases.routes import SCANS

# Minutes of walking.
pytestmark = pytest.mark.slow
CYLINDERS = [(name, route.name) for name, scan in SCANS.items() for route in scan.routes]

Walks = Callable[[str, str, str], MeasuredWalk]


@pytest.fixture(scope="module")
def walk(real_scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Walks:
    """Return a function that walks a route of a scan as a person, once."""
    folder = tmp_path_factory.mktemp("walks")
    scenes: dict[str, tuple[Path, NDArray[np.float64]]] = {}
    walks: dict[tuple[str, str, str], MeasuredWalk] = {}

    def one(name: str, route: str, person: str) -> MeasuredWalk:
        scan = SCANS[name]
        if name not in scenes:
            source = real_scans / scan.file
            build_archive([source], folder / name, BuildConfig(jobs=1))
            scenes[name] = write_scene(folder / name, scan), scan_points(source)
        if (name, route, person) not in walks:
            chosen = next(each for each in scan.routes if each.name == route)
            logs = folder / f"logs-{person}"
            logs.mkdir(exist_ok=True)
            walks[name, route, person] = measure_walk(
                scenes[name][0], scan, chosen, make_person(person), scenes[name][1], logs
            )
        return walks[name, route, person]

    return one


@pytest.mark.parametrize(("name", "route"), CYLINDERS)
def test_a_cylinder_reaches_its_goal_where_it_fits(walk: Walks, name: str, route: str) -> None:
    figures = walk(name, route, "cylinder").figures
    assert (figures["outcome"] == "reached") == figures["fits"], figures.get("reason")


@pytest.mark.parametrize("route", ["corridor", "passage", "parapets", "right jamb", "gallery"])
def test_a_figure_reaches_its_goal(walk: Walks, route: str) -> None:
    figures = walk("indoor_atrium", route, "figure").figures
    assert figures["outcome"] == "reached", figures["reason"]


@pytest.mark.parametrize(
    ("name", "route", "person"),
    [
        *((name, route, "cylinder") for name, route in CYLINDERS),
        ("indoor_atrium", "gallery", "figure"),
        ("octomap_hall", "portal", "figure"),
    ],
)
def test_no_pose_is_in_contact_and_the_replay_is_the_same_bit_for_bit(
    walk: Walks, name: str, route: str, person: str
) -> None:
    """This holds for the walk that sticks, too."""
    figures = walk(name, route, person).figures
    assert figures["poses in contact"] == 0
    touching, judged = figures["in contact by definition"]
    assert touching == 0
    assert judged >= 8
    replayed = figures["replay"]
    assert replayed["frames"] == figures["frames"]
    assert (replayed["different"], replayed["taken"], replayed["reloaded"]) == (0, 0, None)


@pytest.mark.parametrize(
    ("name", "route"),
    [
        ("indoor_atrium", "corridor"),
        ("indoor_atrium", "passage"),
        ("indoor_atrium", "corridor wall"),
        ("indoor_atrium", "gallery"),
        ("octomap_hall", "portal"),
        ("octomap_hall", "opposite portal"),
    ],
)
def test_the_feet_stay_a_few_centimetres_above_a_level_floor(walk: Walks, name: str, route: str) -> None:
    """Clearance is 3 cm above the highest sphere of the floor, whose radius is 1 to 2 cm."""
    walked = walk(name, route, "cylinder")
    heights = walked.heights.bumps[np.isfinite(walked.heights.bumps)]
    assert len(heights) > 0.6 * len(walked.walked.poses), "the floor should be known"
    low, high = np.percentile(heights, [25, 75])
    assert 0.03 <= low <= high <= 0.09
    assert heights.min() > 0.02
    assert heights.max() < 0.15


def test_walks_go_along_walls(walk: Walks) -> None:
    """Otherwise the tests above would show little."""
    assert walk("indoor_atrium", "corridor wall", "cylinder").figures["frames along walls"] > 60
    assert walk("octomap_hall", "portal", "cylinder").figures["frames along walls"] > 10
