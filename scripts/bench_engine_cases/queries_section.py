"""Section `questions`: distance with witness against collide, all other queries; scipy where possible."""

import time
from collections.abc import Callable
from contextlib import suppress

import numpy as np
from measurement.contact_definition import least_distance
from measurement.query_poses import Floats, jittered
from solidcloud.server.report.common.bench_results import Part, ratio
from solidcloud.server.report.common.machine import Clock
from solidcloud.server.scene import Scene

from .bench_context import Bench, attempt
from .compared_sides import BRUTE, COLLIDE, SCIPY, Contender, evenly, time_in_turn, timer

REACH = 0.5  # reach of distance [m]
MAX_RATIO, MIN_RATE = 2.0, 10_000.0
DISTANCE = "distance, witness, 0.5 m"
NEARLY = 1e-6  # tolerance: scipy sums distances in float64 in another order [m]
SCIPY_POSES = 60
RAYS, RAY_REACH = 2000, 30.0
LOOSE, LOOSE_REACH = 20_000, 0.5
TOGETHER = 12  # objects per request


def run(bench: Bench, clock: Clock) -> Part:
    """Time each query."""
    part = Part("questions")
    _compile(bench)
    clock.restart()
    for name, scene in bench.facade.scenes.items():
        attempt(
            part,
            f"distance, {name}",
            lambda name=name, scene=scene: _distance(bench, clock, part, name, scene),
        )
    name, scene = next(iter(bench.facade.scenes.items()))
    for question in (_contacts, _sweep, _raycast, _within, _objects):
        attempt(part, question.__name__[1:], lambda ask=question: ask(bench, clock, part, name, scene))
    return part


def _compile(bench: Bench) -> None:
    """Run each query once to compile it before timing; a missing query is reported later."""
    scene, pose = bench.facade.scene, bench.walk[:1]
    eye = pose[:, :3, 3] + [0.0, 0.0, 1.6]
    first: list[Callable[[], object]] = [
        lambda: scene.distance("avatar", pose, REACH),
        lambda: scene.contacts("avatar", pose),
        lambda: scene.sweep("avatar", pose, pose),
        lambda: scene.raycast(eye, eye, RAY_REACH),
        lambda: scene.within(eye, LOOSE_REACH),
        lambda: scene.objects([("avatar", pose[0]), ("avatar", pose[0])]),
    ]
    for ask in first:
        with suppress(NotImplementedError):
            ask()


# --- distance -------------------------------------------------------------------------------------------


def _distance(bench: Bench, clock: Clock, part: Part, name: str, scene: Scene) -> None:
    place, walk = bench.facade, bench.walk
    clear = walk[~place.contact(walk)]
    case = f"clear poses of the walk, {name}"

    def ask(poses: Floats) -> object:
        return scene.distance("avatar", poses, REACH)

    contenders = [
        Contender(COLLIDE, timer(lambda poses: scene.collide("avatar", poses))),
        Contender(DISTANCE, timer(ask)),
    ]
    for what, spent in time_in_turn(contenders, clear, bench.loops, clock, bench.rng, 0.2).items():
        part.add(case, name, what, spent, "µs", len(clear))
    measured = ratio(part.value(case, name, DISTANCE), part.value(case, name, COLLIDE))
    part.goal(
        "distance collide", f"distance / stateless collide, clear poses ({name})", measured, MAX_RATIO, "x"
    )
    times = time_in_turn([contenders[1]], walk, bench.loops, clock, bench.rng, 0.2)[DISTANCE]
    rate = part.add(f"walk, {name}", name, DISTANCE, [1e6 / t for t in times], "poses/s", len(walk))
    part.goal(
        "distance rate", f"distance, all poses of the walk ({name})", rate, MIN_RATE, "poses/s", at_least=True
    )
    _judge_distance(bench, part, name, scene, case)


def _judge_distance(bench: Bench, part: Part, name: str, scene: Scene, case: str) -> None:
    """Compare with scipy on a sample of clear poses, and with brute force on one of them; time scipy."""
    place = bench.facade
    poses = evenly(bench.walk[~place.contact(bench.walk)], SCIPY_POSES)
    bound = np.nextafter(REACH + place.case.distance, np.inf)
    local, nearest = place.local(poses), np.empty(len(poses))
    begin = time.perf_counter()
    for i, pose in enumerate(local):
        placed = bench.avatar @ pose[:3, :3].T + pose[:3, 3]
        nearest[i] = place.tree.query(placed, distance_upper_bound=bound)[0].min() - place.case.distance
    part.add(case, SCIPY, DISTANCE, (time.perf_counter() - begin) / len(poses) * 1e6, "µs", len(poses))
    found = scene.distance("avatar", poses, REACH).signed_distance
    apart = np.abs(np.where(np.isinf(found) & np.isinf(nearest), 0.0, found - nearest))
    if (apart > NEARLY).any():
        worst = int(np.argmax(apart))
        part.wrong.append(f"distance, {name}: {found[worst]} m where scipy finds {nearest[worst]} m")
    if name != next(iter(place.scenes)):
        return  # brute force tests the same points for any voxel size
    pose = local[:1]
    least_distance(place.case.points[:1], bench.avatar)  # compiles
    begin = time.perf_counter()
    brute = least_distance(place.case.points, bench.avatar @ pose[0, :3, :3].T + pose[0, :3, 3])
    part.add(
        case, BRUTE.replace("integers", "float64"), DISTANCE, (time.perf_counter() - begin) * 1e6, "µs", 1
    )
    if abs(brute - place.case.distance - nearest[0]) > NEARLY:
        part.wrong.append(f"scipy: {nearest[0]} m where brute force finds {brute - place.case.distance} m")


# --- the others -----------------------------------------------------------------------------------------


def _timed(
    bench: Bench,
    clock: Clock,
    part: Part,
    case: str,
    side: str,
    what: str,
    count: int,
    ask: Callable[[], object],
) -> None:
    """Time `ask`, in microseconds per each of the `count` items it queries."""
    ask()
    spent = []
    for _ in clock.loops(bench.loops, 0.15):
        begin = time.perf_counter()
        ask()
        spent.append((time.perf_counter() - begin) / count * 1e6)
    part.add(case, side, what, spent, "µs", count)


def _contacts(bench: Bench, clock: Clock, part: Part, name: str, scene: Scene) -> None:
    poses = bench.walk[bench.facade.contact(bench.walk)]
    case = "colliding poses of the walk"
    _timed(
        bench, clock, part, case, name, "contacts, 100 deepest, a pose", len(poses),
        lambda: scene.contacts("avatar", jittered(poses, bench.rng), 100),
    )  # fmt: skip
    place = bench.facade
    some = place.local(evenly(poses, 30))

    def by_scipy() -> None:
        for pose in some:
            placed = bench.avatar @ pose[:3, :3].T + pose[:3, 3]
            place.tree.query_ball_point(placed, place.case.distance)

    _timed(bench, clock, part, case, SCIPY, "all pairs, not sorted or clustered, a pose", len(some), by_scipy)


def _sweep(bench: Bench, clock: Clock, part: Part, name: str, scene: Scene) -> None:
    def ask() -> object:
        poses = jittered(bench.walk, bench.rng)
        return scene.sweep("avatar", poses[:-1], poses[1:])

    _timed(
        bench,
        clock,
        part,
        "walk, from each pose to the next",
        name,
        "sweep, a motion",
        len(bench.walk) - 1,
        ask,
    )


def _raycast(bench: Bench, clock: Clock, part: Part, name: str, scene: Scene) -> None:
    rng = bench.rng
    origins = evenly(bench.walk, RAYS)[:, :3, 3] + [0.0, 0.0, 1.6]
    origins = np.resize(origins, (RAYS, 3)) + rng.uniform(-0.1, 0.1, (RAYS, 3))
    directions = rng.normal(size=(RAYS, 3))
    _timed(
        bench, clock, part, "from eye height, all directions, 30 m", name, "raycast, a ray", RAYS,
        lambda: scene.raycast(origins, directions, RAY_REACH),
    )  # fmt: skip


def _within(bench: Bench, clock: Clock, part: Part, name: str, scene: Scene) -> None:
    place, rng = bench.facade, bench.rng
    chosen = place.case.points[rng.integers(len(place.case.points), size=LOOSE)]
    local = chosen + rng.normal(scale=0.1, size=(LOOSE, 3))
    world = local + place.case.origin
    case = "loose points about 17 cm from the scan, reach 0.5 m"
    _timed(bench, clock, part, case, name, "within, a point", LOOSE, lambda: scene.within(world, LOOSE_REACH))
    bound = np.nextafter(LOOSE_REACH, np.inf)
    _timed(
        bench, clock, part, case, SCIPY, "within, a point", LOOSE,
        lambda: place.tree.query(local, distance_upper_bound=bound),
    )  # fmt: skip
    found = scene.within(world, LOOSE_REACH).distance
    nearest = place.tree.query(local, distance_upper_bound=bound)[0]
    # scipy's points are up to 15 nm off ours, which are rounded to exact units.
    with np.errstate(invalid="ignore"):
        differs = (np.abs(found - nearest) > NEARLY) & ~(np.isinf(found) & np.isinf(nearest))
    if differs.any():
        part.wrong.append(f"within: {int(differs.sum())} of {LOOSE} distances are not scipy's")


def _objects(bench: Bench, clock: Clock, part: Part, name: str, scene: Scene) -> None:
    groups = [
        np.ascontiguousarray(poses) for poses in np.array_split(bench.walk, len(bench.walk) // TOGETHER)
    ]

    def ask() -> None:
        for poses in groups:
            scene.objects([("avatar", pose) for pose in jittered(poses, bench.rng)])

    case = f"{TOGETHER} figures at successive poses of the walk, in one request"
    _timed(bench, clock, part, case, name, "objects, an object", sum(map(len, groups)), ask)
