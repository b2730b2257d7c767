"""Builds of `.github/stray.png`: a user walks through the door of an office that holds stray points.

The office is that of `solidcloud make office`, its archives are built with the options that
`solidcloud inspect --stray` proposes, and a user walks straight through the door.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.export.export_archive import export_archive
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.plan.stray_points import StrayAdvice, find_stray_points
from solidcloud.builder.sources.scan_files import inspect_scans, open_scans
from solidcloud.builder.synthetic.office import WALL, make_office
from solidcloud.builder.synthetic.truth import read_office_truth

from .drawn_case import Case, Row, section
from .made_shapes import HEIGHT, RADIUS
from .scenarios import FEET, SPEED
from .simulated_walks import FALL, SCAN, Walk, entered, straight

Floats = NDArray[np.float64]

# Where the walk begins, in the room, and how long it takes [m, s].
START, SECONDS = (0.0, 1.3, FEET), 2.0


class Office(NamedTuple):
    """The made office.

    points: (n, 3) of both scans, in the order of the scans [m].  stray: (n,), those that the truth
    names.
    """

    folder: Path
    points: Floats
    stray: NDArray[np.bool_]
    advice: StrayAdvice


def office(folder: Path) -> Office:
    """Return the office in a folder; make it on the first call."""
    target = folder / "office"
    if not target.exists():
        make_office(target)
    truth = read_office_truth(folder / "office.truth.json")
    scans = [points_of(path) for path in sorted(target.iterdir())]
    stray = [np.zeros(len(points), np.bool_) for points in scans]
    for each in truth.strays:
        stray[each.station - 1][each.first : each.first + each.count] = True
    advice = find_stray_points(inspect_scans([target])).advice
    assert advice is not None
    return Office(target, np.concatenate(scans), np.concatenate(stray), advice)


def points_of(path: Path) -> Floats:
    """Return the points (n, 3) of a file of one scan [m]."""
    (scan,) = open_scans(path)
    return np.concatenate([block.xyz for block in scan.blocks()])


def kept_points(made: Office, *options: str) -> Floats:
    """Build an archive of the office; return its points (n, 3) [m].

    options: which of the proposed ones, "outliers" and "moving".
    """
    name = "-".join(["archive", *options])
    folder = made.folder.parent
    if not (folder / name).exists():
        values: dict[str, Any] = {option: getattr(made.advice, option) for option in options}
        build_archive([made.folder], folder / name, BuildConfig(jobs=1, **values))
        export_archive(folder / name, folder / f"{name}.laz")
    return points_of(folder / f"{name}.laz")


def walked(folder: Path, *options: str) -> tuple[Office, Floats, Walk]:
    """Walk through the door in an archive of the office; return also the archive's points."""
    made = office(folder)
    kept = kept_points(made, *options)
    with entered(folder, kept, archive="-".join(["archive", *options])) as scene:
        return made, kept, scene.walk(START, straight(0.0, -SPEED), SECONDS)


def stands_in_the_air(made: Office, walk: Walk) -> bool:
    """Return whether a walk ends at strays: a stray is within 3 cm of the body, and no wall within 20."""
    away = np.linalg.norm(made.points[:, :2] - walk.places[-1, :2], axis=1) - RADIUS
    upright = (made.points[:, 2] > 0.1) & (made.points[:, 2] < HEIGHT)
    return bool(
        walk.touched[-1] == SCAN
        and away[upright & made.stray].min() < 0.03
        and away[upright & ~made.stray].min() > 0.2
    )


def passes(walk: Walk) -> bool:
    """Return whether a walk ends behind the door, on the floor."""
    return bool(walk.places[-1, 1] < -WALL - RADIUS and not (walk.touched == FALL).any())


def scanned(folder: Path) -> Case:
    """Walk with all points of the scans."""
    made, kept, walk = walked(folder)
    claims = {"it stops in the air": stands_in_the_air(made, walk)}
    return _case("scanned", "As scanned", "stops in the air, at a speck of dust", kept, walk, claims)


def outliers(folder: Path) -> Case:
    """Walk without outliers."""
    made, kept, walk = walked(folder, "outliers")
    return _case(
        "outliers", f"--outliers {_value(made.advice.outliers)}", "stops in the air, at what is left of a person",
        kept, walk,
        {"it stops in the air": stands_in_the_air(made, walk), **_gone(made, kept, 0.3, 0.4, 2e-5)},
    )  # fmt: skip


def moving(folder: Path) -> Case:
    """Walk without outliers and without what only one scan saw."""
    made, kept, walk = walked(folder, "outliers", "moving")
    return _case(
        "moving", f"and --moving {_value(made.advice.moving)}", "passes", kept, walk,
        {"it passes": passes(walk), **_gone(made, kept, 0.99, 1.0, 0.034)},
    )  # fmt: skip


def _gone(made: Office, kept: Floats, least: float, most: float, surfaces: float) -> dict[str, bool]:
    """Return the claims on what is left out: a share from `least` to `most` of the strays, and of the rest."""
    stays = int(in_cloud(made.points[made.stray], kept).sum())
    share = 1 - stays / int(made.stray.sum())
    lost = 1 - (len(kept) - stays) / int((~made.stray).sum())
    return {
        f"{least:.0%} to {most:.0%} of the strays are left out": least <= share <= most,
        f"less than {surfaces:.3%} of the surfaces' points are left out": lost < surfaces,
    }


def in_cloud(points: Floats, cloud: Floats) -> NDArray[np.bool_]:
    """Return which of points (n, 3) are in a cloud (m, 3), to a tenth of a millimetre."""
    held = set(map(tuple, np.rint(cloud * 1e4).astype(np.int64).tolist()))
    return np.array([tuple(each) in held for each in np.rint(points * 1e4).astype(np.int64).tolist()])


def _value(rule: tuple[float, int] | None) -> str:
    """Return the value of an option."""
    assert rule is not None
    return f"{rule[0]:g},{rule[1]}"


def _case(name: str, title: str, text: str, kept: Floats, walk: Walk, claims: dict[str, bool]) -> Case:
    """Return the panel of a build."""
    row = Row("plan", section("plan", kept), [walk], (-1.5, -1.35), (1.5, 1.55), 6)
    return Case(name, title, text, (row,), claims)


BUILDS: tuple[Callable[[Path], Case], ...] = (scanned, outliers, moving)
