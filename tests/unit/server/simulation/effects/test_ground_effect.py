"""`ground` and `step`: standing, falling, slopes, stairs, ledges, and holes of the scan."""

from pathlib import Path

import archive_cases
import effect_rooms
import numpy as np
import pytest
from effect_frames import flip_a_byte
from effect_rooms import APART, INTERPRETED, RADIUS, Play, at, play
from numpy.typing import NDArray
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.scene.effect_table import Ground, Slide, Step, Stop, Sweep
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.motion_messages import Moved
from solidcloud.server.simulation.world.frame import Body

FRAMES = 60 if not INTERPRETED else 30
CLEARANCE = 0.03
PERSON = effect_rooms.person()
ALL = (Stop(), Sweep(), Slide(), Step(), Ground())
# Feet above the scan points that are stood on: between two of them a sphere stands lower.
STANDS = RADIUS + CLEARANCE
DIPS = RADIUS + PERSON.radius - np.sqrt((RADIUS + PERSON.radius) ** 2 - APART**2 / 2)


def floor(side: float = 2.0) -> NDArray[np.float64]:
    """A level floor at z = 0."""
    return effect_rooms.plane((-side / 2, -side / 2, 0), (side / 2, side / 2, 0))


def settled(game: Play, body: Body, frames: int = FRAMES) -> Moved:
    """Let a body fall, or stand."""
    for _ in range(frames):
        moved = game.go(body, (0, 0, 0))
        assert not game.touches(body)
    return moved


@pytest.fixture(scope="module")
def level(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """A floor."""
    return effect_rooms.build(tmp_path_factory.mktemp("floor"), floor())


@pytest.mark.interpreted
@pytest.mark.parametrize("effects", [(Stop(), Ground()), ALL])
def test_who_falls_lands_and_stands(
    level: archive_cases.Case, effects: tuple[Stop | Sweep | Slide | Step | Ground, ...]
) -> None:
    with play(level.archive, *effects) as game:
        height = 1.0 if not INTERPRETED else 0.3
        body = game.body(PERSON, at(0.02, 0.03, height))
        speed = 0.0
        for frame in range(1, FRAMES):  # noqa: B007  how many it took
            before = body.pose[2, 3]
            moved = game.go(body, (0, 0, 0))
            assert moved.ground is not None and not game.touches(body)
            if moved.ground.on_ground:
                break
            speed += 9.81 / 30
            assert moved.ground.speed == pytest.approx(speed)
            assert before - body.pose[2, 3] == pytest.approx((speed - 9.81 / 60) / 30, abs=1e-9)
        assert moved.ground.on_ground and body.fall_speed == 0.0
        assert abs(frame / 30 - np.sqrt(2 * (height - STANDS) / 9.81)) < 0.08
        assert STANDS - DIPS - 1e-3 <= body.pose[2, 3] <= STANDS + 1e-3
        assert moved.ground.normal == pytest.approx((0, 0, 1), abs=0.02)
        before_bits = body.pose.tobytes()
        settled(game, body, 3)
        assert body.pose.tobytes() == before_bits


@pytest.mark.interpreted
@pytest.mark.parametrize("speed", [50.0])
def test_no_fall_is_so_fast_that_it_passes_a_floor(level: archive_cases.Case, speed: float) -> None:
    with play(level.archive, *ALL) as game:
        body = game.body(PERSON, at(0.02, 0.03, 3.0))
        body.fall_speed = speed
        for _ in range(FRAMES):
            game.go(body, (0, 0, 0), seconds=0.1)
            assert body.pose[2, 3] > 0.0 and not game.touches(body)
        assert body.on_ground


@pytest.mark.interpreted
@pytest.mark.parametrize("up", [(0, 1, 0), (1, 2, 2)])
def test_up_may_be_any_direction(tmp_path: Path, up: tuple[float, float, float]) -> None:
    unit = np.array(up) / np.linalg.norm(up)
    side = np.linalg.svd(unit[None])[2][1:]
    turn = np.stack([side[0], np.cross(unit, side[0]), unit], axis=1)
    case = effect_rooms.build(tmp_path, floor(1.2) @ turn.T)
    with play(case.archive, *ALL, up=up) as game:
        body = game.body(PERSON, archive_cases.pose_of(turn, unit * 0.3))
        settled(game, body)
        assert body.on_ground and STANDS - DIPS - 1e-3 <= body.pose[:3, 3] @ unit <= STANDS + 1e-3
        before = body.pose.tobytes()
        settled(game, body, 3)
        assert body.pose.tobytes() == before


def ramp(degrees: float) -> NDArray[np.float64]:
    """A plane that rises along x by so many degrees, through the origin."""
    angle = np.radians(degrees)
    flat = effect_rooms.plane((-1.2, -0.8, 0), (1.2, 0.8, 0))
    return flat @ np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])


@pytest.mark.interpreted
@pytest.mark.parametrize("degrees", [10, 40])
def test_slopes_are_stood_on_and_walked_up(tmp_path: Path, degrees: float) -> None:
    case = effect_rooms.build(tmp_path, ramp(degrees))
    with play(case.archive, *ALL) as game:
        body = game.body(PERSON, at(-0.5, 0, 0.4))
        moved = settled(game, body)
        assert body.on_ground and moved.ground is not None and moved.ground.normal is not None
        assert moved.ground.normal[2] == pytest.approx(np.cos(np.radians(degrees)), abs=0.02)
        before = body.pose.copy()
        settled(game, body, 5)
        np.testing.assert_array_equal(body.pose, before)
        count = 20 if not INTERPRETED else 3
        for _ in range(count):
            game.go(body, (0.03, 0, 0))
            assert body.on_ground and not game.touches(body)
        gone = body.pose[:3, 3] - before[:3, 3]
        assert gone[0] > 0.8 * 0.03 * count and gone[2] == pytest.approx(
            gone[0] * np.tan(np.radians(degrees)), abs=0.03
        )


@pytest.mark.interpreted
@pytest.mark.parametrize("degrees", [55])
def test_what_is_too_steep_is_slid_down_and_not_climbed(tmp_path: Path, degrees: float) -> None:
    case = effect_rooms.build(tmp_path, ramp(degrees))
    with play(case.archive, *ALL) as game:
        body = game.body(PERSON, at(0.0, 0, 0.7 if degrees < 60 else 1.0))
        heights = []
        for _ in range(25 if not INTERPRETED else 5):
            game.go(body, (0.03, 0, 0))
            heights.append(body.pose[2, 3])
            assert not game.touches(body) and not body.on_ground
        assert (np.diff(heights) < 1e-9).all() and heights[-1] < heights[0] - 0.05


@pytest.mark.parametrize(("degrees", "slope"), [(40.0, 30.0)])
def test_who_is_pushed_at_a_slope_that_is_too_steep_stands_at_its_foot(
    tmp_path: Path, degrees: float, slope: float
) -> None:
    up = np.round(np.arange(0.0, 1.0, APART), 6)
    x, y = (axis.ravel() for axis in np.meshgrid(up, np.round(np.arange(-0.5, 0.5, APART), 6)))
    rise = np.stack([x, y, x * np.tan(np.radians(degrees))], axis=1)
    flat = effect_rooms.plane((-1.0, -0.5, 0), (-APART, 0.5, 0))
    case = effect_rooms.build(tmp_path, np.concatenate([flat, rise]))
    with play(case.archive, Stop(), Sweep(), Slide(), Step(), Ground(slope=slope)) as game:
        body = game.body(PERSON, at(-0.6, 0, 0.1))
        settled(game, body, 15)
        places = []
        for _ in range(60):
            game.go(body, (0.03, 0, 0))
            assert body.on_ground and not game.touches(body)
            places.append(body.pose[:3, 3].copy())
        assert np.ptp(places[-30:], axis=0).max() < 1e-4, "it does not tremble"
        assert places[-1][0] > -0.35 and places[-1][2] < 0.1


def stairs(riser: float, tread: float = 0.3, count: int = 3) -> NDArray[np.float64]:
    """Stairs up along x from x = 0, floors before and behind."""
    apart = APART
    parts = [effect_rooms.plane((-1.0, -0.6, 0), (0, 0.6, 0), apart)]
    for step in range(count):
        x, z = step * tread, step * riser
        parts.append(effect_rooms.plane((x, -0.6, z), (x, 0.6, z + riser), apart))
        parts.append(effect_rooms.plane((x, -0.6, z + riser), (x + tread, 0.6, z + riser), apart))
    x, z = count * tread, count * riser
    parts.append(effect_rooms.plane((x, -0.6, z), (x + 1.2, 0.6, z), apart))
    return np.unique(np.round(np.concatenate(parts), 6), axis=0)


@pytest.mark.parametrize(("riser", "pace"), [(0.1, 0.045), (0.17, 0.03)])
def test_stairs_are_climbed_and_descended(tmp_path: Path, riser: float, pace: float) -> None:
    case = effect_rooms.build(tmp_path, stairs(riser))
    with play(case.archive, *ALL) as game:
        body = game.body(PERSON, at(-0.6, 0, 0.15))
        settled(game, body, 10)
        stepped = 0.0
        for _ in range(round(2.2 / pace)):
            moved = game.go(body, (pace, 0, 0))
            stepped += moved.stepped
            assert moved.stepped <= 0.2 + 1e-3 and body.on_ground and not game.touches(body)
        assert body.pose[0, 3] > 1.3 and body.pose[2, 3] == pytest.approx(3 * riser + STANDS, abs=0.02)
        assert stepped > riser
        for _ in range(round(2.2 / pace)):
            moved = game.go(body, (-pace, 0, 0))
            assert body.on_ground and body.fall_speed == 0.0 and not game.touches(body)
        assert body.pose[0, 3] < -0.3 and body.pose[2, 3] == pytest.approx(STANDS, abs=0.02)


@pytest.mark.parametrize("effects", [(Stop(), Sweep(), Slide(), Ground()), ALL])
def test_a_riser_that_is_too_high_is_a_wall(
    tmp_path: Path, effects: tuple[Stop | Sweep | Slide | Step | Ground, ...]
) -> None:
    riser = 0.26 if len(effects) == 5 else 0.17
    case = effect_rooms.build(tmp_path, stairs(riser, count=1))
    with play(case.archive, *effects) as game:
        body = game.body(PERSON, at(-0.6, 0, 0.15))
        settled(game, body, 10)
        for _ in range(60):
            moved = game.go(body, (0.04, 0, 0))
            assert moved.stepped == 0.0 and not game.touches(body)
        assert body.pose[0, 3] < -0.1 and body.pose[2, 3] < 0.12 and body.on_ground


def test_a_ledge_higher_than_a_step_is_fallen_from(tmp_path: Path) -> None:
    case = effect_rooms.build(tmp_path, stairs(0.5, count=1))
    with play(case.archive, *ALL) as game:
        body = game.body(PERSON, at(0.6, 0, 0.6))
        settled(game, body, 10)
        fell = 0.0
        for _ in range(60):
            game.go(body, (-0.04, 0, 0))
            fell = max(fell, body.fall_speed)
            assert not game.touches(body)
        assert fell > 1.0 and body.on_ground and body.pose[2, 3] == pytest.approx(STANDS, abs=0.02)


@pytest.mark.parametrize(("snap", "falls"), [(0.1, True), (0.25, False), (None, False)])
def test_lower_ground_is_followed_as_far_as_it_snaps(
    tmp_path: Path, snap: float | None, *, falls: bool
) -> None:
    case = effect_rooms.build(tmp_path, stairs(0.17, count=1))
    with play(case.archive, Stop(), Sweep(), Slide(), Step(), Ground(snap=snap)) as game:
        body = game.body(PERSON, at(0.6, 0, 0.3))
        settled(game, body, 10)
        fell = 0.0
        for _ in range(60):
            game.go(body, (-0.04, 0, 0))
            fell = max(fell, body.fall_speed)
            assert not game.touches(body)
        assert (fell > 0.0) == falls
        assert body.on_ground and body.pose[2, 3] == pytest.approx(STANDS, abs=0.02)


def test_a_hole_of_the_scan_is_walked_over(tmp_path: Path) -> None:
    points = floor(3.0)
    hole = (np.abs(points[:, 0]) < 0.45) & (np.abs(points[:, 1]) < 0.45)
    deeper = np.concatenate([points[~hole], effect_rooms.plane((-0.4, -0.4, -3.0), (0.4, 0.4, -3.0))])
    for cloud, falls in ((points[~hole], False), (deeper, True)):
        case = effect_rooms.build(tmp_path, cloud)
        with play(case.archive, *ALL) as game:
            body = game.body(PERSON, at(-1.0, 0, 0.1))
            settled(game, body, 10)
            low = 1.0
            for _ in range(50):
                game.go(body, (0.04, 0, 0))
                low = min(low, body.pose[2, 3])
                assert not game.touches(body)
            assert (low < 0.0) == falls and (falls or body.pose[0, 3] > 0.9)


@pytest.mark.interpreted
def test_nobody_falls_into_what_cannot_be_read(tmp_path: Path) -> None:
    case = effect_rooms.build(tmp_path, floor(1.2))
    with Archive(case.archive) as opened:
        voxels = [tuple(voxel) for voxel in opened.coordinates.tolist()]
    for voxel in voxels:
        flip_a_byte(case.archive, voxel)
    with play(case.archive, *ALL) as game:
        body = game.body(PERSON, at(0, 0, 2.0))
        for _ in range(FRAMES):
            moved = game.go(body, (0, 0, 0))
        assert moved.verdict == Verdict.UNKNOWN and body.pose[2, 3] > 0.0 and body.fall_speed == 0.0
        assert any(touched.unknown for touched in moved.touched)
        assert game.world.collide(PERSON, body.pose) == Verdict.CLEAR
