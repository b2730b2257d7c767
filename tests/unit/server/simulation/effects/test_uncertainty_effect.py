"""`uncertainty`, the effect: against a Monte Carlo judge that displaces scans, at its extremes, and what it refuses."""

import math
import shutil
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from effect_frames import body_of, flip_a_byte, report, world_of
from kept_archives import build_or_copy
from msgspec import structs
from numpy.typing import NDArray
from solidcloud.builder.config import BuildConfig
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.scene.effect_table import Uncertainty
from solidcloud.schemas.wire.motion_messages import UncertaintyReport
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.effects.uncertainty_effect import check, make

RADIUS = 0.01
BODY = np.array([[x, 0.0, z] for x in (-0.1, 0.0, 0.1) for z in (0.0, 0.2)])
MODEL = make_avatar(BODY, 0.05)


@contextmanager
def opened(folder: Path, *clouds: NDArray[np.float64], keep: bool = True) -> Any:
    """An archive of scans scan0.ply, scan1.ply, ... of these points (n, 3), opened."""
    paths = [
        synthetic_scans.write_ply(folder / f"scan{number}.ply", points)
        for number, points in enumerate(clouds)
    ]
    options = {"voxel": 4.0, "resolution": 1e-5, "radius": RADIUS, "jobs": 1}
    build_or_copy(paths, folder / "archive", BuildConfig(keep=frozenset({"scan"} if keep else ()), **options))
    with Scene.open(folder / "archive", "scene") as scene:
        yield scene


def floor(height: float, shift: float = 0.0) -> NDArray[np.float64]:
    """A patch of floor, its points 4 cm apart."""
    steps = np.arange(-0.2, 0.2, 0.04) + shift
    x, y = np.meshgrid(steps, steps)
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, height)])


def at(height: float) -> NDArray[np.float64]:
    """The body so far above."""
    return archive_cases.pose_of(np.eye(3), np.array([0.003, 0.0, height]))


def said(scene: Scene, pose: NDArray[np.float64], **options: Any) -> UncertaintyReport:
    """What the effect reports."""
    world = world_of(scene)
    return report(make(Uncertainty(**options), world), world, body_of(MODEL), pose)


def judged(
    rng: np.random.Generator,
    clouds: list[NDArray[np.float64]],
    sigmas: list[float],
    height: float,
    draws: int,
) -> tuple[float, float]:
    """How often spheres touch, each scan displaced by one normal deviate along the gap of its nearest pair; with the
    standard error. All pairs, drawn anew every time."""
    body = BODY + at(height)[:3, 3]
    ways = []
    for points in clouds:
        apart = (body[:, None] - points).reshape(-1, 3)
        nearest = apart[np.linalg.norm(apart, axis=1).argmin()]
        ways.append(nearest / np.linalg.norm(nearest))
    touching = 0
    for _ in range(draws):
        touching += any(
            np.linalg.norm((body[:, None] - points) - rng.normal(0, sigma) * way, axis=2).min()
            <= 0.05 + RADIUS
            for points, sigma, way in zip(clouds, sigmas, ways, strict=True)
        )
    share = touching / draws
    return share, math.sqrt(max(share * (1 - share), 1 / draws) / draws)


@pytest.mark.interpreted
@pytest.mark.parametrize("gap", [0.004, -0.003])
def test_two_scans_touch_as_often_as_displaced_ones_do(
    tmp_path: Path, rng: np.random.Generator, gap: float
) -> None:
    clouds, sigmas = [floor(0.0), floor(-0.004, 0.013)], [0.005, 0.008]
    height = gap + 0.05 + RADIUS
    with opened(tmp_path, *clouds) as scene:
        found = said(scene, at(height), sigma=sigmas[0], scans={"scan1.ply": sigmas[1]})
    share, error = judged(rng, clouds, sigmas, height, 1500)
    assert abs(found.probability - share) <= 4 * error
    assert not found.unknown and sorted(found.scans) == ["scan0.ply", "scan1.ply"]
    both = 1 - (1 - found.scans["scan0.ply"]) * (1 - found.scans["scan1.ply"])
    assert found.probability == pytest.approx(both, abs=1e-12)


@pytest.mark.interpreted
def test_the_gap_of_one_scan_gives_the_tail_of_the_normal_distribution(tmp_path: Path) -> None:
    point = np.array([[0.003, 0.0, 0.0], [0.003, 3.0, 0.0]])
    for keep in (True, False):
        folder = tmp_path / str(keep)
        folder.mkdir()
        with opened(folder, point, keep=keep) as scene:
            for gap in (-0.02, -0.005, 0.0, 0.005, 0.0195):
                found = said(scene, at(gap + 0.05 + RADIUS), sigma=0.005)
                expected = 0.5 * math.erfc(gap / 0.005 / math.sqrt(2))
                assert found.probability == pytest.approx(expected, abs=1e-4)
                assert found.scans == {"scan0.ply": found.probability} and not found.unknown


@pytest.mark.interpreted
def test_deep_inside_it_is_certain_and_far_away_nothing_is_asked(tmp_path: Path) -> None:
    with opened(tmp_path, floor(0.0), floor(-0.004)) as scene:
        world = world_of(scene)
        runner, body = make(Uncertainty(sigma=0.005), world), body_of(MODEL)
        assert report(runner, world, body, at(0.0)).probability > 1 - 1e-15
        for height in (0.5, 0.45, 0.4, 0.35):
            assert report(runner, world, body, at(height)) == UncertaintyReport(0.0)


@pytest.mark.interpreted
def test_what_could_not_be_read_is_unknown(tmp_path: Path) -> None:
    with opened(tmp_path, floor(0.0), floor(-0.004)) as scene:
        folder = tmp_path / "archive"
        flip_a_byte(folder, (0, 0, 0))
        near = said(scene, archive_cases.pose_of(np.eye(3), np.array([0.5, 0.1, -0.5])), sigma=0.005)
        assert not near.unknown and near.probability == 0.0, "out of reach of what is missing"
        found = said(scene, at(0.06), sigma=0.005)
    assert found.unknown


@pytest.mark.interpreted
def test_archives_at_poses_count_as_scans_of_their_own(tmp_path: Path, rng: np.random.Generator) -> None:
    there = archive_cases.pose_of(archive_cases.random_rotation(rng), np.array([3.0, -2, 1]))
    with opened(tmp_path, floor(0.0), floor(-0.004, 0.013)) as scene:
        runner_world = world_of(scene)
        plain = report(make(Uncertainty(), runner_world), runner_world, body_of(MODEL), at(0.062))
        world = world_of(scene, poses=[there])
        carried = report(make(Uncertainty(), world), world, body_of(MODEL), there @ at(0.062))
        world = world_of(scene, scene, poses=[there, there])
        twice = report(make(Uncertainty(), world), world, body_of(MODEL), there @ at(0.062))
    assert carried.probability == pytest.approx(plain.probability, abs=1e-5)
    assert twice.probability == pytest.approx(1 - (1 - plain.probability) ** 2, abs=1e-5)


def test_a_name_that_no_scan_has_is_refused_when_the_scene_is_opened(tmp_path: Path) -> None:
    with opened(tmp_path, floor(0.0), floor(-0.004)) as scene:
        info = scene.info()
        paths = [source.path for source in info.sources]
        for good in ("scan1.ply", paths[0], f"{paths[0]}:0"):
            check(Uncertainty(scans={good: 0.01}), info)
        with pytest.raises(
            BadRequestError, match=r"'scan2.ply' is not a scan of scene: expected scan0.ply, scan1.ply"
        ):
            check(Uncertainty(scans={"scan2.ply": 0.01}), info)
    other = structs.replace(
        info, scene="other", sources=[structs.replace(info.sources[0], path="x/hall.e57")]
    )
    check(Uncertainty(scans={"hall.e57": 0.01, "scan1.ply": 0.02}), info, other)
    lost = structs.replace(other, sources=[structs.replace(other.sources[0], fault="unreadable")])
    with pytest.raises(BadRequestError, match=r"'hall.e57' is not a scan of other"):
        check(Uncertainty(scans={"hall.e57": 0.01}), lost)
    many = [structs.replace(info.sources[0], path=f"s{number}.e57") for number in range(20)]
    with pytest.raises(BadRequestError, match="and 12 more"):
        check(Uncertainty(scans={"hall.e57": 0.01}), structs.replace(info, sources=many))


@pytest.mark.interpreted
def test_after_a_reload_scans_are_those_of_the_new_archive(tmp_path: Path) -> None:
    own, new = tmp_path / "own", tmp_path / "new"
    own.mkdir()
    new.mkdir()
    with opened(new, floor(-0.01), floor(-0.02), floor(0.0)) as scene:
        expected = said(scene, at(0.06), sigma=0.005, scans={"scan1.ply": 0.02})
    with opened(own, floor(0.0), floor(0.0, 0.01)) as scene:
        world = world_of(scene)
        runner, body = make(Uncertainty(sigma=0.005, scans={"scan1.ply": 0.02}), world), body_of(MODEL)
        assert sorted(report(runner, world, body, at(0.06)).scans) == ["scan0.ply", "scan1.ply"]
        shutil.rmtree(own / "archive")
        (new / "archive").rename(own / "archive")
        scene.reload()
        found = report(runner, world, body, at(0.06))
    assert found == expected and sorted(found.scans) == ["scan0.ply", "scan1.ply", "scan2.ply"]
