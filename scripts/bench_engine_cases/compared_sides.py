"""One place with every side ready, and the timing of the sides in turn.

The sides are ours, the crates, scipy and brute force. The crates warm up on the same poses that
they are timed on, ours on others: any effect of this favours the crates.
"""

import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from measurement.contact_definition import Judge
from measurement.measured_archives import contact_distance, stored_points
from measurement.query_poses import Floats, PoseSet, gaps, jittered
from numpy.typing import NDArray
from peers.peers_program import Peers
from peers.reference_verdicts import Case
from scipy.spatial import cKDTree
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.report.common.bench_results import Part
from solidcloud.server.report.common.machine import Clock, say
from solidcloud.server.report.common.whole_scene import open_whole
from solidcloud.server.scene import Scene

TABLE = "multilevel voxel table"
CAPT, CAPT16 = "CAPT SIMD, best lanes", "CAPT SIMD, 16 lanes"
SCIPY, BRUTE = "scipy cKDTree", "brute force, integers"
OURS = "ours"
# Names in scripts/peers. The scalar variants, never faster, are in bench_walk.
PEERS = {"mvtable_simd": TABLE, "capt_simd": CAPT, "capt_simd16": CAPT16}
# A second or two of scipy is enough to rank it.
SCIPY_POSES, SCIPY_LOOPS = 300, 2
JUDGED = 12  # sampled poses of a set that the judge decides, and maximum of those where the sides differ
COLLIDE = "collide"


class Contender(NamedTuple):
    """One side.

    time: (poses to warm up with, poses (k, 4, 4) world) -> microseconds per pose, answers included.
    touching: poses -> (k,) bool, or None where it is not compared.
    most: maximum poses it is timed on, evenly spread.
    loops: maximum repetitions.
    """

    name: str
    time: Callable[[Floats, Floats], float]
    touching: Callable[[Floats], NDArray[np.bool_]] | None = None
    most: int | None = None
    loops: int | None = None


class Place:
    """Scanned place: scenes, the peers' program, scipy's tree and the judge over the same points.

    The points are those that the archives store.
    archives: name of a side -> archive.
    avatar: (m, 3) [m].
    walk: poses (k, 4, 4) world, on which the peers choose their settings.
    program: of the peers, or the reason for its absence.
    folder: for the program's input.
    """

    def __init__(
        self,
        archives: dict[str, Path],
        avatar: Floats,
        walk: Floats,
        program: Path | str,
        folder: Path,
        stack: ExitStack,
    ) -> None:
        self.archives, self.avatar, self.walk = archives, avatar, walk
        self.scenes = {name: stack.enter_context(open_whole(path)) for name, path in archives.items()}
        distance = contact_distance(list(self.scenes.values()), avatar)
        points = stored_points(next(iter(archives.values())))
        info = self.scene.info()
        self.radius = distance - info.radius  # radius of the avatar
        self.case = Case(points, np.array(info.origin), avatar, walk, distance)
        self.tree = cKDTree(points)
        self.judge = Judge(points + self.case.origin, info.origin, info.lattice_step, info.radius)
        self.peers: Peers | None = None
        self.peers_missing = program if isinstance(program, str) else None
        if isinstance(program, Path):
            say("trying every setting of the peers (about a minute)")
            folder.mkdir(exist_ok=True)
            peers = Peers(program, folder, points, avatar, self.case.local_poses(), distance, 3)
            self.peers = stack.enter_context(peers)

    @property
    def scene(self) -> Scene:
        """Return the first of our scenes."""
        return next(iter(self.scenes.values()))

    def local(self, poses: Floats) -> Floats:
        """Transform world poses (k, 4, 4) to the frame of the points."""
        moved = poses.copy()
        moved[:, :3, 3] -= self.case.origin
        return moved

    def contact(self, poses: Floats) -> NDArray[np.bool_]:
        """Return which poses (k,) touch, according to our first scene."""
        return _touching(self.scene, poses)

    def settings(self) -> list[str]:
        """Return the fastest settings found for each peer."""
        if self.peers is None:
            return [f"CAPT and the voxel table were not measured: {self.peers_missing}"]
        found = [
            "the peers keep the settings that are fastest on the walk, whatever poses they are asked about"
        ]
        for key, name in PEERS.items():
            row = self.peers.sides.get(key, {})
            width = row.get("cell_width")
            found.append(
                f"{name}: {row.get('lanes')} lanes, avatar in {row.get('avatar_order')} order"
                + (f", cells {width:g} m" if width else "")
                + f", {row.get('bytes', 0) / len(self.case.points):,.0f} bytes a point"
                + f", built in {row.get('build_s', 0):.1f} s"
            )
        return found

    def contenders(self, *, scipy: bool = True) -> list[Contender]:
        """Return every side of `collide`."""
        found = [
            Contender(name, _timed(scene), lambda poses, scene=scene: _touching(scene, poses))
            for name, scene in self.scenes.items()
        ]
        if self.peers is not None:
            found += [self._peer(key, name) for key, name in PEERS.items() if key in self.peers.sides]
        if scipy:
            found.append(Contender(SCIPY, self._scipy, None, SCIPY_POSES, SCIPY_LOOPS))
        return found

    def _peer(self, key: str, name: str) -> Contender:
        peers = self.peers
        assert peers is not None

        def turn(_: Floats, poses: Floats) -> float:
            return peers.turn(key, peers.give("turn", self.local(poses)))

        def touching(poses: Floats) -> NDArray[np.bool_]:
            file = peers.give("asked", self.local(poses))
            peers.turn(key, file)
            return peers.touching_of(key, file)

        return Contender(name, turn, touching)

    def _scipy(self, _: Floats, poses: Floats) -> float:
        bound = np.nextafter(self.case.distance, np.inf)  # scipy's bound is exclusive, ours is not
        local = self.local(poses)
        begin = time.perf_counter()
        for pose in local:
            placed = self.avatar @ pose[:3, :3].T + pose[:3, 3]
            np.isfinite(self.tree.query(placed, distance_upper_bound=bound)[0]).any()
        return (time.perf_counter() - begin) / len(poses) * 1e6

    def brute(self, poses: Floats) -> float:
        """Time the definition on every pair of points [us per pose]; the first contact ends the search."""
        self.judge.touches(self.avatar, self.radius, poses[0])  # compiles
        begin = time.perf_counter()
        for pose in poses:
            self.judge.touches(self.avatar, self.radius, pose, all_pairs=True)
        return (time.perf_counter() - begin) / len(poses) * 1e6


def _touching(scene: Scene, poses: Floats) -> NDArray[np.bool_]:
    answers = scene.collide("avatar", poses)
    if (answers.verdict == Verdict.UNKNOWN).any() or answers.faults:
        raise SystemExit(f"some poses are unknown ({answers.faults}): nothing to time, check the archive")
    return np.asarray(answers.verdict == Verdict.CONTACT)


def _timed(scene: Scene) -> Callable[[Floats, Floats], float]:
    """Return the timer of `Scene.collide` on all poses in one call, after a warm-up call."""
    return timer(lambda poses: scene.collide("avatar", poses))


def timer(ask: Callable[[Floats], Any]) -> Callable[[Floats, Floats], float]:
    """Return a function that times a query about poses after a warm-up: microseconds per pose."""

    def turn(warm: Floats, poses: Floats) -> float:
        ask(warm)
        begin = time.perf_counter()
        ask(poses)
        return (time.perf_counter() - begin) / len(poses) * 1e6

    return turn


def evenly(poses: NDArray[Any], most: int | None) -> NDArray[Any]:
    """Return at most `most` of the poses (k, ...), evenly spread."""
    if most is None or len(poses) <= most:
        return poses
    return poses[np.linspace(0, len(poses) - 1, most).astype(int)]


def time_in_turn(
    contenders: list[Contender],
    poses: Floats,
    loops: int,
    clock: Clock,
    rng: np.random.Generator,
    share: float = 0.5,
) -> dict[str, list[float]]:
    """Time the sides in turn; return the microseconds per pose of each repetition.

    Each repetition jitters all poses anew.
    """
    times: dict[str, list[float]] = {c.name: [] for c in contenders}
    for loop in clock.loops(loops, share):
        warm, asked = jittered(poses, rng), jittered(poses, rng)
        for c in contenders:
            clock.look_around()
            if c.loops is None or loop < c.loops:
                times[c.name].append(c.time(evenly(warm, c.most), evenly(asked, c.most)))
    return times


def compare_set(
    part: Part,
    case: str,
    place: Place,
    poses: PoseSet,
    loops: int,
    clock: Clock,
    rng: np.random.Generator,
    share: float,
) -> None:
    """Time every side on one set of poses and compare their verdicts with the judge; adds to `part`."""
    label = f"{case}, {poses.name}"
    if not len(poses.poses):
        part.missing.append(f"{label}: no such poses here")
        return
    contenders = place.contenders()
    found = {c.name: c.touching(poses.poses) for c in contenders if c.touching is not None}
    ours = next(iter(found.values()))
    hold(part, label, place, poses.poses, ours, found)
    for name, times in time_in_turn(contenders, poses.poses, loops, clock, rng, share).items():
        most = next(c.most for c in contenders if c.name == name)
        part.add(label, name, COLLIDE, times, "µs", len(evenly(poses.poses, most)))
    part.remarks.append(f"{label}: {poses.said}; {int(ours.sum())} of {len(ours)} in contact")


def hold(
    part: Part,
    label: str,
    place: Place,
    poses: Floats,
    ours: NDArray[np.bool_],
    found: dict[str, NDArray[np.bool_]],
) -> None:
    """Compare a sample of poses, and those where sides differ, with the judge."""
    differing = np.flatnonzero(np.any([verdicts != ours for verdicts in found.values()], axis=0))
    kinds = [np.flatnonzero(ours), np.flatnonzero(~ours), differing]
    asked = np.unique(np.concatenate([evenly(kind, JUDGED) for kind in kinds]))
    mine = 0
    truth = {int(i): place.judge.touches(place.avatar, place.radius, poses[i]) for i in asked}
    for name, verdicts in found.items():
        mistaken = [i for i, touches in truth.items() if touches != bool(verdicts[i])]
        mine = len(mistaken) if verdicts is ours else mine
        differs = int((verdicts != ours).sum())
        if mistaken and name in place.scenes:
            part.wrong.append(f"{label}, {name}: not as the definition says for poses {mistaken}")
        elif name in place.scenes and differs:
            part.wrong.append(f"{label}, {name}: {differs} verdicts are not those of {next(iter(found))}")
        elif differs:
            off = gaps(place.tree, place.avatar, place.local(poses[mistaken]), place.case.distance)
            part.remarks.append(
                f"{label}: {name} differs from ours on {differs} poses; of {len(truth)} judged by the definition "
                f"it is wrong on {len(mistaken)}, ours on {mine}"
                + (
                    f"; at most {np.abs(off).max() * 1e6:.2g} µm from tangency, it computes in float32"
                    if mistaken
                    else ""
                )
            )
