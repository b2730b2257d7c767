"""Prefetching: what is wanted comes before it is asked for, soonest first, and never in anybody's way.

What users will need: straight on, turning, stopping, with jitter, after a teleport; who is forgotten when.
"""

import time
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
from fake_store import BLOCK, FakeStore
from numpy.typing import NDArray
from solidcloud.schemas.archive.voxel_grid import voxel_keys
from solidcloud.server.kernels.core.reach import VoxelTree, make_voxel_tree
from solidcloud.server.residency.prefetch import (
    PREFETCH_OPTIONS,
    STALE,
    Prefetcher,
    User,
    UserTracks,
)
from solidcloud.server.residency.voxel_cache import VoxelCache

PATIENCE = 20.0  # [s], for what takes microseconds when it is right
ANNA = ("client", "anna")


class Wishes:
    """A neighbourhood that wants what it is told to. wanted: row -> seconds.  standing: rows kept."""

    def __init__(self) -> None:
        self.wanted: dict[int, float] = {}
        self.standing: list[int] = []
        self.gone: list[str] = []
        self.plans = 0

    def record_pose(self, user: User, now: float, center: tuple[float, float, float], reach: float) -> bool:
        """Whether a user comes from nowhere is read off its reach."""
        return reach > 100.0

    def leave_client(self, client: str) -> None:
        """A client went, and nothing is wanted any more."""
        self.gone.append(client)
        self.wanted, self.standing = {}, []

    def expire(self, now: float, after: float) -> None:
        """Nobody is."""

    def plan(self, now: float, load_seconds: float) -> dict[int, float]:
        """What is wanted, soonest first."""
        self.plans += 1
        return dict(sorted(self.wanted.items(), key=lambda item: item[1]))

    def kept(self) -> np.ndarray:
        """What users stand in."""
        return np.array(self.standing, np.int64)


class Table:
    """A residency of voxels of some blocks each, its prefetcher, and who wishes."""

    def __init__(self, sizes: list[int], blocks: int, **options: object) -> None:
        self.store = FakeStore(sizes)
        self.residency = VoxelCache(self.store, blocks * BLOCK)  # type: ignore[arg-type]
        self.wishes = Wishes()
        self.prefetcher = Prefetcher(self.residency, self.wishes, **options)  # type: ignore[arg-type]

    def __enter__(self) -> None: ...

    def __exit__(self, *_: object) -> None:
        self.prefetcher.stop()

    def see(self) -> None:
        """A user moves."""
        self.prefetcher.record_pose(ANNA, (0.0, 0.0, 0.0), 1.0)

    def resident(self) -> list[int]:
        """The rows that are there."""
        return np.flatnonzero(self.residency.where[:, 0] >= 0).tolist()


def until(condition: Callable[[], bool]) -> bool:
    """Whether it comes to be, before patience ends."""
    end = time.monotonic() + PATIENCE
    while not condition() and time.monotonic() < end:
        time.sleep(0.001)
    return condition()


def test_what_is_wanted_is_loaded_soonest_first_and_counted() -> None:
    table = Table([1] * 5, 5)
    table.wishes.wanted = {3: 0.5, 1: 0.1, 4: 2.0}
    with table:
        table.see()
        assert until(lambda: table.resident() == [1, 3, 4])
        assert list(table.store.loads) == [1, 3, 4], "in this order"
        with table.residency.hold([1]) as held:
            assert (held.hits, held.misses) == (1, 0)
        counters = table.residency.counters()
        assert (counters.prefetched, counters.used, counters.wasted) == (3, 1, 0)
        assert counters.prefetched_bytes == 3 * BLOCK
    table.residency.check()


def test_what_users_stand_in_or_need_sooner_does_not_go() -> None:
    table = Table([1] * 6, 3)
    table.wishes.wanted = {0: 0.0, 1: 0.2, 2: 0.4, 3: 0.6, 4: 0.8}
    table.wishes.standing = [0]
    with table:
        table.see()
        assert until(lambda: table.resident() == [0, 1, 2])
        plans = table.wishes.plans
        table.see()
        assert until(lambda: table.wishes.plans > plans)
        assert table.resident() == [0, 1, 2] and table.residency.stats.evicted == 0
        # A request may have the room of what is only wanted, and of what is stood in last of all.
        with table.residency.hold([4, 5]) as held:
            assert held.misses == 2 and table.resident() == [0, 4, 5]
        assert table.residency.counters().wasted == 2
        with table.residency.hold([1, 2, 3]):
            assert table.resident() == [1, 2, 3]
    table.residency.check()


def test_nothing_is_begun_while_a_request_waits() -> None:
    table = Table([1] * 3, 3)
    table.store.gate.clear()
    table.wishes.wanted = {1: 0.1}
    with table:
        from concurrent.futures import ThreadPoolExecutor

        with ThreadPoolExecutor(1) as pool:
            asked = pool.submit(lambda: table.residency.acquire([0]))
            assert table.store.wait_for_load(0, PATIENCE)
            table.see()
            assert until(lambda: table.wishes.plans > 0)
            assert not table.store.wait_for_load(1, 0.05)
            table.store.gate.set()
            assert asked.result(PATIENCE).misses == 1
        assert until(lambda: table.resident() == [0, 1])
        table.residency.release([0])


def test_what_came_too_late_for_a_request_is_loaded_after_it() -> None:
    table = Table([1] * 3, 2, prefetch=False)
    with table:
        with table.residency.hold([0, 2], deadline=0.0) as held:
            assert held.late == (0, 2)
        assert until(lambda: table.resident() == [0, 2])
        counters = table.residency.counters()
        assert (counters.late, counters.prefetched, counters.used) == (2, 0, 0)
    table.residency.check()


@pytest.mark.parametrize("fault", ["corrupt", "unreadable", "out of memory"])
def test_a_load_that_fails_leaves_nothing_and_the_next_goes_on(fault: str) -> None:
    table = Table([1] * 3, 3)
    table.store.faults[0] = fault
    table.wishes.wanted = {0: 0.1, 1: 0.2}
    with table:
        table.see()
        assert until(lambda: table.store.loads[0] > 0)
        table.see()
        assert until(lambda: table.resident() == [1])
        table.wishes.wanted = {}
        counters = table.residency.counters()
        assert counters.prefetched == 1 + counters.failed and counters.wasted == counters.failed >= 1
        table.store.faults.clear()
        with table.residency.hold([0]) as held:
            assert bool(held.faults) == (fault == "corrupt")
    table.residency.check()


def test_a_client_that_goes_keeps_nothing() -> None:
    table = Table([1] * 3, 3)
    table.wishes.wanted, table.wishes.standing = {0: 0.0}, [0]
    with table:
        table.see()
        assert until(lambda: table.residency.kept == {0} and table.resident() == [0])
        table.prefetcher.leave_client("client")
        assert until(lambda: not table.residency.kept)
        assert table.wishes.gone == ["client"]


def test_who_comes_from_nowhere_is_told_so_and_idle_time_is_used() -> None:
    calls: list[int] = []
    table = Table([1] * 3, 3, idle=(calls.append(step) for step in range(3)))
    with table:
        assert table.prefetcher.record_pose(ANNA, (0.0, 0.0, 0.0), 1e3)
        assert not table.prefetcher.record_pose(ANNA, (0.0, 0.0, 0.0), 1.0)
        assert until(lambda: len(calls) == 3)


def test_after_a_stop_nothing_is_loaded() -> None:
    table = Table([1] * 3, 3)
    table.wishes.wanted = {0: 0.0}
    table.prefetcher.stop()
    table.see()
    with table.residency.hold([1], deadline=0.0) as held:
        assert held.late == (1,)
    time.sleep(0.02)
    assert not table.store.loads
    table.prefetcher.stop()


STEP, VOXEL_STEPS = 0.01, 200
EDGE = STEP * VOXEL_STEPS
ORIGIN = np.array([1000.0, -500.0, 20.0])
ME, YOU = ("client", "me"), ("client", "you")
REACH = 0.5
NO_RING = PREFETCH_OPTIONS._replace(ring=0.0)


def tree_of(low: NDArray[np.int64], high: NDArray[np.int64]) -> VoxelTree:
    """The tree over the boxes of voxels (v, 3), of which no scan was left out."""
    bounds = np.stack([low.min(axis=0), high.max(axis=0)])
    return make_voxel_tree(low, high, bounds, np.empty((0, 2, 3), np.int64))


def floor(side: int = 20) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """A floor of 2 m voxels, side by side, each full of points: low corners and coordinates (v, 3)."""
    x, y = np.meshgrid(np.arange(-side, side), np.arange(-side, side))
    coordinates = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size, np.int64)])
    coordinates = coordinates[np.argsort(voxel_keys(coordinates))]
    return coordinates * VOXEL_STEPS, coordinates


LOW, COORDINATES = floor()
HIGH = LOW + VOXEL_STEPS - 1
TREE = tree_of(LOW, HIGH)


class Wanted(NamedTuple):
    """The voxels of a plan, rows (n,), and the seconds until each, need (n,)."""

    rows: NDArray[np.int64]
    need: NDArray[np.float64]


def plan(around: UserTracks, now: float, load_seconds: float) -> Wanted:
    """What is wanted, soonest first."""
    found = around.plan(now, load_seconds)
    return Wanted(np.array(list(found), np.int64), np.array(list(found.values())))


def make(ahead: object = PREFETCH_OPTIONS) -> UserTracks:
    """Nobody there yet."""
    return UserTracks(TREE, ORIGIN, STEP, ahead)  # type: ignore[arg-type]


def at(x: float, y: float) -> tuple[float, float, float]:
    """A place above the floor, from the lattice's origin [m]."""
    return (ORIGIN[0] + x, ORIGIN[1] + y, ORIGIN[2] + 1.0)


def cells(rows: NDArray[np.int64]) -> set[tuple[int, int]]:
    """Which voxels rows are."""
    return {(int(x), int(y)) for x, y, _ in COORDINATES[rows]}


def touched(x: float, y: float, reach: float) -> set[tuple[int, int]]:
    """Brute force: the voxels a ball at a place of the floor touches."""
    center = np.array([x, y, 1.0]) / STEP
    gap = np.maximum(np.maximum(LOW - center, center - HIGH), 0)
    return cells(np.flatnonzero(np.sqrt((gap**2).sum(axis=1)) <= reach / STEP))


def walk(
    around: UserTracks, places: NDArray[np.float64], start: float = 0.0, user: tuple[str, str] = ME
) -> float:
    """See a user at places (k, 2), 30 a second. Returns the time of the last."""
    for number, (x, y) in enumerate(places):
        assert not around.record_pose(user, start + number / 30, at(x, y), REACH)
    return start + (len(places) - 1) / 30


def straight(speed: float, poses: int = 30) -> NDArray[np.float64]:
    """Along x from (1, 1), in the middle of a voxel."""
    return np.column_stack([1.0 + speed * np.arange(poses) / 30, np.ones(poses)])


def test_straight_on_the_next_voxels_come_in_their_order_and_time() -> None:
    around = make(NO_RING)
    now = walk(around, straight(3.0))
    wanted = plan(around, now, 0.25)
    x = straight(3.0)[-1, 0]  # 3.9 m; the reach ends 0.5 m ahead, voxels at 2, 4, 6, ...
    assert NO_RING.horizon(0.25) == 2.0
    assert [cell for cell in cells(wanted.rows) if cell[1] != 0] == []
    order = [int(c[0]) for c in COORDINATES[wanted.rows]]
    assert order == sorted(order) and order[-1] in (4, 5), "6 m ahead and half a metre"
    for column, need in zip(order, wanted.need.tolist(), strict=True):
        assert need == pytest.approx(max(0.0, (column * EDGE - REACH - x) / 3.0), abs=0.1)
    assert wanted.need[0] == 0.0


def test_who_stands_wants_what_is_around_and_what_it_touches_first() -> None:
    around = make()
    now = walk(around, np.tile([1.9, 1.0], (70, 1)))
    wanted = plan(around, now, 0.25)
    assert cells(wanted.rows) == touched(1.9, 1.0, REACH + PREFETCH_OPTIONS.ring)
    here = touched(1.9, 1.0, REACH)
    assert cells(wanted.rows[: len(here)]) == here and (wanted.need[: len(here)] == 0).all()
    low, high = LOW[wanted.rows] * STEP, HIGH[wanted.rows] * STEP
    gap = np.maximum(np.maximum(low - [1.9, 1.0, 1.0], [1.9, 1.0, 1.0] - high), 0)
    beyond = (np.sqrt((gap**2).sum(axis=1)) - REACH) / PREFETCH_OPTIONS.ring
    expected = PREFETCH_OPTIONS.horizon(0.25) * (1 + beyond[len(here) :])
    for later in (0.0, STALE + 0.1):  # not heard of for a while: the same
        need = plan(around, now + later, 0.25).need
        assert np.allclose(need[len(here) :], expected, rtol=0.02) and (np.diff(need) >= 0).all()
    assert len(expected) > 1


def make_plan(ahead: object, places: NDArray[np.float64]) -> Wanted:
    """What a user who went along places wants."""
    around = make(ahead)
    return plan(around, walk(around, places), 0.25)


def test_who_turns_wants_what_is_ahead_of_it_now() -> None:
    """A quarter of a circle of 2 m at 3 m/s, from along x to along y."""
    angle = np.linspace(0.0, np.pi / 2, 32)
    places = np.column_stack([1.0 + 2.0 * np.sin(angle), 1.0 + 2.0 * (1 - np.cos(angle))])
    wanted = cells(make_plan(NO_RING, places).rows)
    assert {(1, 2), (1, 3)} <= wanted
    assert not any(x >= 3 for x, _ in wanted), "where it was heading a moment ago is wanted no more"


def test_the_second_pose_tells_the_velocity() -> None:
    around = make(NO_RING)
    walk(around, straight(3.0, 2))
    (track,) = around._users.values()
    assert np.allclose(track.velocity, [3.0, 0.0, 0.0])


@pytest.mark.parametrize("apart", [0.0, 0.001, 0.01, 0.1])
def test_the_velocity_does_not_depend_on_the_intervals_of_poses(apart: float) -> None:
    """Of two users at one speed, the poses of one arrive in pairs."""
    around = make(NO_RING)
    for number in range(20):
        for now, user in ((number / 10, ME), (number / 10, YOU), (number / 10 + apart, YOU)):
            around.record_pose(user, now, at(3.0 * now, 1.0), REACH)
    mine, yours = (each.velocity for each in around._users.values())
    assert np.allclose(mine, [3.0, 0.0, 0.0], rtol=0.01) and np.allclose(mine, yours, rtol=0.01)


@pytest.mark.parametrize("seed", range(2))
def test_jitter_changes_little(seed: int) -> None:
    """A centimetre of place, ten milliseconds of clock: what will be touched in a second is wanted all the same."""
    rng = np.random.default_rng(seed)
    around = make()
    places = straight(1.5, 60) + rng.normal(0, 0.01, (60, 2))
    times = np.maximum.accumulate(np.arange(60) / 30 + rng.uniform(0, 0.01, 60))
    for now, (x, y) in zip(times.tolist(), places.tolist(), strict=True):
        assert not around.record_pose(ME, now, at(x, y), REACH)
    wanted = plan(around, float(times[-1]), 0.25)
    soon = wanted.rows[wanted.need <= 2.0]
    end = straight(1.5, 60)[-1, 0]
    for ahead in np.linspace(0.0, 1.0, 20):
        assert touched(end + 1.5 * ahead, 1.0, REACH - 0.3) <= cells(soon)


def test_a_teleport_is_said_and_what_was_before_is_dropped() -> None:
    around = make(NO_RING)
    now = walk(around, straight(5.0))
    assert around.record_pose(ME, now + 1 / 30, at(-30.0, -30.0), REACH)
    wanted = plan(around, now + 1 / 30, 0.5)
    assert cells(wanted.rows) == touched(-30.0, -30.0, REACH) and (wanted.need == 0).all()
    assert cells(around.kept()) == touched(-30.0, -30.0, REACH)
    assert not around.record_pose(ME, now + 2 / 30, at(-29.9, -30.0), REACH)


def test_poses_out_of_order_are_passed_over() -> None:
    around = make(NO_RING)
    now = walk(around, straight(3.0))
    before = plan(around, now, 0.25)
    assert not around.record_pose(ME, now - 0.01, at(-20, -20), REACH)
    after = plan(around, now, 0.25)
    assert after.rows.tolist() == before.rows.tolist() and after.need.tolist() == before.need.tolist()


def test_a_user_wants_no_more_than_so_many_and_the_soonest() -> None:
    few = make_plan(NO_RING._replace(most_wanted=2), straight(3.0, 70))
    many = make_plan(NO_RING, straight(3.0, 70))
    assert len(few.rows) == 2 < len(many.rows)
    assert few.rows.tolist() == many.rows[:2].tolist()


def test_who_leaves_is_forgotten() -> None:
    around = make()
    other = ("other", "me")
    for user in (ME, YOU, other):
        walk(around, straight(1.0), user=user)
    assert list(around._users) == [ME, YOU, other]
    around.leave_client("client")
    assert list(around._users) == [other] and len(plan(around, 1.0, 0.1).rows)
    around.expire(29 / 30 + 10.0, 10.0)
    assert list(around._users) == [other]
    around.expire(11.0, 10.0)
    assert (
        list(around._users) == [] and len(plan(around, 11.0, 0.1).rows) == 0 and around.kept().tolist() == []
    )


# --- against brute force over all voxels at many moments of the way ---------------------------


@pytest.mark.parametrize("ring", [0.0, 0.6])
@pytest.mark.parametrize(("side", "count", "reach"), [(6, 700, 0.4), (3, 300, 0.0)])
def test_what_is_wanted_is_what_brute_force_finds(side: int, count: int, reach: float, ring: float) -> None:
    """Three users in voxels that are scattered in space, each with a box of points inside it."""
    rng = np.random.default_rng([side, count])
    coordinates = np.unique(rng.integers(-side, side, (count, 3)), axis=0)
    base = coordinates[np.argsort(voxel_keys(coordinates))] * VOXEL_STEPS
    ends = np.sort(rng.integers(0, VOXEL_STEPS, (2, len(base), 3)), axis=0)
    low, high = base + ends[0], base + ends[1]
    ahead, met = PREFETCH_OPTIONS._replace(ring=ring, settled=0.0, most_wanted=1000), 0
    for turn in range(20):
        around = UserTracks(tree_of(low, high), np.zeros(3), STEP, ahead)
        expected: dict[int, tuple[float, float]] = {}
        for user in range(3):
            speed = rng.normal(0, 1, 3) * (0.0 if turn % 5 == 0 else rng.choice([0.3, 2.0, 8.0]))
            place = low[rng.integers(len(low))] * STEP + rng.uniform(-0.2, 0.2, 3)
            for number in range(20):
                at = place + speed * number / 30
                around.record_pose(("c", str(user)), number / 30, tuple(at.tolist()), reach)
        now, horizon = 19 / 30, ahead.horizon(0.25)
        wanted = plan(around, now, 0.25)
        assert len(set(wanted.rows.tolist())) == len(wanted.rows) and (np.diff(wanted.need) >= 0).all()
        wide = reach / STEP + 1.0
        for track in around._users.values():
            along = np.linspace(0.0, horizon, 801)
            centers = (track.center + along[:, None] * track.velocity) / STEP
            away = np.maximum(np.maximum(low - centers[:, None], centers[:, None] - high), 0)
            ball, cube = np.sqrt((away**2).sum(axis=2)), away.max(axis=2)
            # Between moments they move at most half of what they move from one to the next.
            between = np.linalg.norm(centers[1] - centers[0]) / 2
            for row in range(len(low)):
                near = ball[0, row] - wide
                late = [np.inf, np.inf]  # latest and earliest need that are right
                for which, touched in ((0, ball[:, row] <= wide), (1, cube[:, row] <= wide + 0.2 + between)):
                    if touched.any():
                        late[which] = along[np.flatnonzero(touched)[0]] - which * along[1]
                    elif near <= ring / STEP and ring:
                        late[which] = horizon * (1.0 + max(near, 0.0) / (ring / STEP))
                known = expected.get(row, (np.inf, np.inf))
                expected[row] = min(known[0], late[0]), min(known[1], late[1])
        found = dict(zip(wanted.rows.tolist(), wanted.need.tolist(), strict=True))
        for row, (latest, earliest) in expected.items():
            assert earliest - 1e-4 <= found.get(row, np.inf) <= latest + 1e-4
        met += len(found)
    assert met > 5
