"""Collision world: the archives of a scene as one, queried by effects for one avatar at a time.

An archive with a pose in the world is queried under the inverse of that pose, and witnesses are
transformed back. A single archive at the identity, by far the most frequent case, is queried
directly.
"""

import threading
from collections import OrderedDict
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.errors import CorruptError
from ....schemas.scene.scene_file import SceneFile
from ....schemas.wire.answers import ContactsAnswers, DistanceAnswers, Verdict, WithinAnswers
from ...archives.archive_generation import ArchiveGeneration
from ...archives.placed_archive import PlacedArchive
from ...archives.rigid_transform import rotate_vectors, transform_points, transform_poses
from ...avatars.avatar_model import AvatarModel
from ...kernels.core.normal_codes import MAX_NORMAL_REACH
from ...queries.contacts import contacts
from ...queries.context.query_budget import EXACT, QueryBudget
from ...queries.context.query_context import SceneData, with_stop
from ...queries.resident_fast_path import ResidentQueries, SweepResult, distance_fast
from ...queries.within import within
from ...runtime.stop_flag import NO_STOP, StopFlag, StoppedError
from ...scene_interface import EVERYBODY
from .frame import Hit, Pose, Vec
from .vectors import min_height, unit_vector

_NO_ORIGIN = np.zeros(3)
# If the points near a touched one form no surface, because the scan is sparse, the reach of its
# normal is multiplied by this factor.
SPARSE_FACTOR = 3.0
# Limit on the avatars (of users and objects) for which a thread keeps a `ResidentQueries`.
_MAX_PROBES = 256
# Limit on the points of these avatars, some 100 MB a thread: those of dropped avatars also count.
_MAX_PROBED_POINTS = 1 << 20


class HeldArchive(NamedTuple):
    """Archive generation that a thread holds. data: with the scene's radius model."""

    opened: ArchiveGeneration
    data: SceneData
    placed: PlacedArchive


class AvatarProbes:
    """The last avatars of one thread, each with its `ResidentQueries`."""

    def __init__(self) -> None:
        self._probes: OrderedDict[int, ResidentQueries] = OrderedDict()
        self._points = 0

    def of(self, avatar: AvatarModel) -> ResidentQueries:
        """Return the `ResidentQueries` of an avatar."""
        probes, key = self._probes, id(avatar.points)
        probe = probes.get(key)
        if probe is None or probe.avatar.arrays is not avatar.arrays or probe.avatar.radius != avatar.radius:
            if probe is not None:
                self._points -= len(probes.pop(key).avatar.points)
            probe = probes[key] = ResidentQueries(avatar)
            self._points += len(avatar.points)
            while len(probes) > 1 and (len(probes) > _MAX_PROBES or self._points > _MAX_PROBED_POINTS):
                _, oldest = probes.popitem(last=False)
                self._points -= len(oldest.avatar.points)
        return probe


class _Held(threading.local):
    """State of one thread: the archives it holds, and its probes."""

    depth = 0
    visits = 0
    stop: StopFlag = NO_STOP
    unknown = False

    def __init__(self) -> None:
        self.seen: list[HeldArchive] = []
        self.probes = AvatarProbes()


class World:
    """Collision world of one scene. Thread-safe.

    file: the scene file.  up: (3,) unit vector against gravity.  archives: of the scene.
    walker: see `walker_of` in frame_walk.py.  bodies: see `bodies_of` in body_effects.py.
    """

    walker: Any = None
    bodies: Any = None

    def __init__(self, scene: Any, file: SceneFile) -> None:
        """Create the world of a scene, an object with `archives` and `avatar` such as `Scene`."""
        self.file, self._scene = file, scene
        self.up: Vec = unit_vector(file.up)
        self.archives: list[PlacedArchive] = list(scene.archives)
        self._alone = len(self.archives) == 1 and self.archives[0].pose is None
        self._held = _Held()

    def __enter__(self) -> list[HeldArchive]:
        """Hold the current archive generations, which this thread queries inside the `with`."""
        held = self._held
        if not held.depth:
            seen: list[HeldArchive] = []
            try:
                for placed in self.archives:
                    opened = placed.take()
                    seen.append(HeldArchive(opened, opened.data, placed))
                    data = with_stop(opened.radius_model(self.file.radius_model), held.stop)
                    seen[-1] = HeldArchive(opened, data, placed)
            except BaseException:
                for each in seen:
                    each.opened.release()
                raise
            held.seen = seen
        held.depth += 1
        return held.seen

    def begin(self, stop: StopFlag) -> None:
        """Begin a frame of this thread. stop: flag for its queries from the next hold on."""
        self._held.stop, self._held.unknown = stop, False

    @property
    def unknown(self) -> bool:
        """Return whether a query of this thread's frame was incomplete."""
        return self._held.unknown

    def count(self, visits: int, missing: int = 0) -> None:
        """Add the cost of a query of this thread.

        visits: of nodes.  missing: number of voxels that were not available.
        """
        self._held.visits += visits
        if missing:
            self._held.unknown = True

    def __exit__(self, *_: object) -> None:
        """Release the archives."""
        held = self._held
        held.depth -= 1
        if not held.depth:
            seen, held.seen = held.seen, []
            for each in seen:
                each.opened.release()

    def avatar(self, name: str) -> AvatarModel:
        """Return an avatar of the scene file. Raise UnknownAvatarError until they are added."""
        model: AvatarModel = self._scene.avatar(name, EVERYBODY)
        return model

    @property
    def visits(self) -> int:
        """Return the node visits of all queries of this thread."""
        return self._held.visits

    def _count_of(
        self, answers: ContactsAnswers | DistanceAnswers | WithinAnswers, budget: QueryBudget
    ) -> None:
        """Add the cost of one row of answers."""
        budget.lacked(len(answers.late))
        unknown = answers.verdict[0] == Verdict.UNKNOWN
        self.count(int(answers.node_visits[0]), int(answers.voxels_missing[0]) or unknown)

    def generations(self) -> tuple[int, ...]:
        """Return the generation numbers of the current archives, which a reload changes."""
        with self as seen:
            return tuple([each.opened.number for each in seen])

    def saw(self, user: tuple[str, str], avatar: AvatarModel, pose: Pose, around: float = 0.0) -> None:
        """Record a user's pose, around which voxels are prefetched. Call it inside a `with`.

        around: distance beyond the avatar's spheres [m].
        """
        for each in self._held.seen:
            each.opened.record_user(user, avatar, to_archive(each, pose), around)

    def collide(self, avatar: AvatarModel, pose: Pose, budget: QueryBudget = EXACT) -> Verdict:
        """Return the verdict at a pose (4, 4) over all archives; see server/queries/collide.py."""
        found, probe = Verdict.CLEAR, self._held.probes.of(avatar)
        with self as seen:
            for each in seen:
                verdict, visits = probe.collide(each.data, to_archive(each, pose), budget)
                self.count(visits, verdict == Verdict.UNKNOWN)
                if verdict == Verdict.CONTACT:
                    return verdict
                if verdict == Verdict.UNKNOWN:
                    found = verdict
        return found

    def sweep(
        self,
        avatar: AvatarModel,
        pose_from: Pose,
        pose_to: Pose,
        tolerance: float = 1e-6,
        budget: QueryBudget = EXACT,
        skin: float = -1.0,
    ) -> SweepResult:
        """Return when the avatar first touches any archive on its way between two poses.

        See server/queries/sweep.py. Of several archives, `lower` is the least; `upper` and witness
        are those of the earliest contact, of simultaneous ones that with the least witness.
        skin: see `ResidentQueries.sweep`; `end` is known only for a single archive.
        """
        found, probe = None, self._held.probes.of(avatar)
        with self as seen:
            for number, each in enumerate(seen):
                begin, end = to_archive(each, pose_from), to_archive(each, pose_to)
                swept = probe.sweep(each.data, begin, end, tolerance, budget, skin if self._alone else -1.0)
                self.count(swept.visits, swept.unknown)
                if not self._alone:
                    swept = swept_in_world(swept, each, number)
                found = swept if found is None else merge_swept(found, swept)
        assert found is not None
        return found

    def between(
        self, avatar: AvatarModel, pose_from: Pose, pose_to: Pose, fraction: float
    ) -> tuple[Pose, bool]:
        """Return the pose at a fraction of a motion, and whether the proof of `sweep` covers it."""
        with self as seen:
            origin = seen[0].data.arrays.origin if self._alone else _NO_ORIGIN
            pose, same = self._held.probes.of(avatar).between(origin, pose_from, pose_to, fraction)
        return pose, same and self._alone

    @property
    def is_alone(self) -> bool:
        """Return whether the world is a single archive at the identity."""
        return self._alone

    def probe(self, avatar: AvatarModel) -> ResidentQueries:
        """Return this thread's `ResidentQueries` of an avatar."""
        return self._held.probes.of(avatar)

    def lowest_height(self) -> float:
        """Return the height of the lowest corner of the archives' boxes, spheres included [m]."""
        least = np.inf
        with self as seen:
            for each in seen:
                arrays = each.data.arrays
                box = each.data.tree.scene * arrays.step + arrays.origin
                corners = np.array([[box[i & 1, 0], box[i >> 1 & 1, 1], box[i >> 2, 2]] for i in range(8)])
                if each.placed.pose is not None:
                    corners = transform_points(each.placed.pose, corners)
                radius = each.data.radius_units / UNITS_PER_METRE
                least = min(least, min_height(corners, self.up) - radius)
        return least

    def deepest(self, avatar: AvatarModel, pose: Pose, budget: QueryBudget = EXACT) -> Hit | None:
        """Return the deepest contact at a pose, with fraction 0, or None.

        Of equally deep contacts, it is that with the least witness.
        """
        found: Hit | None = None
        depth = np.inf
        with self as seen:
            for number, each in enumerate(seen):
                answers = contacts(each.data, avatar, to_archive(each, pose)[None], 1, budget=budget)
                self._count_of(answers, budget)
                if len(answers.signed_distance):
                    value = float(answers.signed_distance[0])
                    own, cloud = (
                        to_world(each, place) for place in (answers.avatar_point[0], answers.cloud_point[0])
                    )
                    if found is None or comes_first(value, (cloud, own), depth, (found.cloud, found.avatar)):
                        depth, found = value, Hit(0.0, Verdict.CONTACT, own, cloud, "", number)
        return found

    def nearest(self, place: Vec, reach: float, budget: QueryBudget = EXACT) -> Hit | None:
        """Return the scan point nearest to a place (3,) within `reach` [m], as a Hit.

        Of several points at the same distance, it is the least (x, y, z). Return None if there is
        none within `reach`.
        """
        found: Hit | None = None
        least = np.inf
        with self as seen:
            for number, each in enumerate(seen):
                inverse = each.placed.inverse
                there = place if inverse is None else transform_points(inverse, place[None])[0]
                answers = within(each.data, there[None], reach, budget)
                self._count_of(answers, budget)
                value = float(answers.distance[0])
                if value > least or value == np.inf:
                    continue
                cloud = to_world(each, answers.cloud_point[0])
                if found is None or comes_first(value, (cloud,), least, (found.cloud,)):
                    least = value
                    found = Hit(0.0, Verdict(int(answers.verdict[0])), None, cloud, "", number)
        return found

    def distance(
        self, avatar: AvatarModel, pose: Pose, reach: float, budget: QueryBudget = EXACT
    ) -> DistanceAnswers:
        """Return the distance of the avatar from the nearest archive at one pose.

        See server/queries/distance.py, and `comes_first` for several at the same distance.
        """
        found, body = None, self._held.probes.of(avatar).body.reference
        with self as seen:
            for each in seen:
                answers = distance_fast(each.data, avatar, to_archive(each, pose), reach, budget, body)
                self._count_of(answers, budget)
                if each.placed.pose is not None:
                    answers = msgspec.structs.replace(
                        answers,
                        witness_avatar=transform_points(each.placed.pose, answers.witness_avatar),
                        witness_cloud=transform_points(each.placed.pose, answers.witness_cloud),
                        normal=rotate_vectors(each.placed.pose, answers.normal),
                    )
                found = answers if found is None else merge_distances(found, answers)
        assert found is not None
        return found

    def contacts(
        self,
        avatar: AvatarModel,
        pose: Pose,
        limit: int = 100,
        margin: float = 0.0,
        cluster_distance: float | None = None,
        budget: QueryBudget = EXACT,
    ) -> list[ContactsAnswers]:
        """Return the contacts at a pose, for each archive; see server/queries/contacts.py."""
        found = []
        with self as seen:
            for each in seen:
                answers = contacts(
                    each.data, avatar, to_archive(each, pose)[None], limit, margin, cluster_distance, budget
                )
                self._count_of(answers, budget)
                if each.placed.pose is not None:
                    columns = ("avatar_point", "cloud_point", "cluster_avatar", "cluster_cloud")
                    carried = {
                        name: transform_points(each.placed.pose, getattr(answers, name)) for name in columns
                    }
                    answers = msgspec.structs.replace(answers, **carried)
                found.append(answers)
        return found

    def normal(self, hit: Hit, reach: float, budget: QueryBudget = EXACT) -> Vec | None:
        """Return the unit normal (3,) of the touched surface, towards the avatar, or None.

        reach: distance within which points form the surface of the touched one [m]. If they form
        none, it is multiplied by SPARSE_FACTOR, up to MAX_NORMAL_REACH.
        """
        if hit.cloud is None or hit.avatar is None or hit.archive < 0:
            return hit.normal  # hit of a body, whose normal is known
        return self.normal_at(hit.archive, hit.cloud, hit.avatar - hit.cloud, reach, budget)

    def normal_at(
        self, archive: int, cloud: Vec, toward: Vec, reach: float, budget: QueryBudget = EXACT
    ) -> Vec | None:
        """Return `normal` at a scan point (3,) of an archive, on the side of a direction (3,).

        Return None too if a voxel within reach cannot be read, or is not in memory and the budget
        does not wait: the frame is then `unknown`.
        """
        held = self._held
        with self as seen:
            each = seen[archive]
            normals, pose = normals_of(each), each.placed.pose
            place, way = touched_in_archive(each, cloud, toward[None])
            waits = budget.late is None
            try:
                found: Vec | None = normals.at(place, way[0], reach, held.stop, waits=waits)
                if found is None:
                    farther = min(SPARSE_FACTOR * reach, MAX_NORMAL_REACH)
                    found = normals.at(place, way[0], farther, held.stop, waits=waits)
            except CorruptError:
                held.unknown = True
                return None
            except StoppedError:
                if waits or held.stop:
                    raise
                budget.lacked(1)
                held.unknown = True
                return None
            return found if found is None or pose is None else rotate_vectors(pose, found[None])[0]

    def highest(
        self, hit: Hit, directions: NDArray[np.float64], reach: float, budget: QueryBudget = EXACT
    ) -> NDArray[np.float64]:
        """Return how high the scan points around a touched one lie along directions (k,) [m].

        hit: of the scan.  directions: (k, 3) unit.  reach, budget: as for `normal`. Return 0 if
        a voxel within reach is not in memory, or cannot be read.
        """
        assert hit.cloud is not None
        held, waits = self._held, budget.late is None
        with self as seen:
            each = seen[hit.archive]
            place, ways = touched_in_archive(each, hit.cloud, directions)
            try:
                found: NDArray[np.float64] = normals_of(each).highest(
                    place, ways, reach, held.stop, waits=waits
                )
            except CorruptError:
                held.unknown = True
                return np.zeros(len(directions))
            except StoppedError:
                if waits or held.stop:
                    raise
                budget.lacked(1)
                held.unknown = True
                return np.zeros(len(directions))
        return found


def normals_of(seen: HeldArchive) -> Any:
    """Return the `Normals` of an archive generation."""
    kept = seen.opened.kept
    normals = kept.get("normals")
    if normals is None:
        # Imported here: only some effects need normals.
        from ...queries.surface_normals import Normals

        normals = kept.setdefault("normals", Normals(seen.data, seen.opened.store.archive))
    return normals


def touched_in_archive(
    seen: HeldArchive, cloud: Vec, ways: NDArray[np.float64]
) -> tuple[Vec, NDArray[np.float64]]:
    """Return a scan point (3,) and directions (k, 3) of the world in an archive's frame."""
    inverse = seen.placed.inverse
    if inverse is None:
        return cloud, ways
    return transform_points(inverse, cloud[None])[0], rotate_vectors(inverse, ways)


def to_archive(seen: HeldArchive, pose: Pose) -> Pose:
    """Return a pose of the world in an archive's frame."""
    inverse = seen.placed.inverse
    return pose if inverse is None else transform_poses(inverse, pose[None])[0]


def to_world(seen: HeldArchive, place: NDArray[np.float64]) -> Vec:
    """Return a point (3,) of an archive in the world frame."""
    pose = seen.placed.pose
    return place if pose is None else transform_points(pose, place[None])[0]


def swept_in_world(swept: SweepResult, seen: HeldArchive, number: int) -> SweepResult:
    """Return an archive's answer about a motion, in the world frame."""
    if swept.avatar is None or swept.cloud is None:
        return swept._replace(archive=number)
    return swept._replace(
        archive=number, avatar=to_world(seen, swept.avatar), cloud=to_world(seen, swept.cloud)
    )


def comes_first(
    value: float, witness: tuple[Vec | None, ...], other: float, other_witness: tuple[Vec | None, ...]
) -> bool:
    """Return whether an answer replaces that of an earlier archive (NUMERICS.md N11).

    value, witness: of the answer.  other, other_witness: of the earlier archive. The lesser value
    comes first; of equal values, that with the least witness: scan point, then avatar centre, as in
    merge_answers.py.
    """
    if value != other:
        return value < other
    for own, place in zip(witness, other_witness, strict=True):
        if own is None or place is None:
            return False
        one, two = own.tolist(), place.tolist()
        if one != two:
            return bool(one < two)
    return False


def merge_swept(one: SweepResult, other: SweepResult) -> SweepResult:
    """Return the merged answer of two archives about a motion."""
    other_first = comes_first(other.upper, (other.cloud, other.avatar), one.upper, (one.cloud, one.avatar))
    first = other if other_first else one
    lower = min(one.lower, other.lower)
    verdict = Verdict.CLEAR if lower >= 1.0 else Verdict.UNKNOWN
    if first.upper < np.inf:
        verdict = Verdict.CONTACT
    exact = first.exact and lower >= first.lower
    return first._replace(
        verdict=verdict,
        lower=lower,
        exact=exact,
        visits=one.visits + other.visits,
        unknown=one.unknown or other.unknown,
    )


def merge_distances(one: DistanceAnswers, other: DistanceAnswers) -> DistanceAnswers:
    """Return the merged answer of two archives about a distance."""
    other_first = comes_first(
        float(other.signed_distance[0]), (other.witness_cloud[0], other.witness_avatar[0]),
        float(one.signed_distance[0]), (one.witness_cloud[0], one.witness_avatar[0]),
    )  # fmt: skip
    first = other if other_first else one
    verdicts = {int(one.verdict[0]), int(other.verdict[0])}
    verdict = Verdict.CONTACT if Verdict.CONTACT in verdicts else max(verdicts)
    lower = min(one.lower[0], other.lower[0])
    return msgspec.structs.replace(
        first,
        verdict=np.array([verdict], np.uint8),
        lower=np.array([lower]),
        upper=np.array([min(one.upper[0], other.upper[0])]),
        exact=np.array([bool(first.exact[0]) and lower >= first.lower[0]]),
        outside=one.outside & other.outside,
        voxels_missing=one.voxels_missing + other.voxels_missing,
        node_visits=one.node_visits + other.node_visits,
        point_tests=one.point_tests + other.point_tests,
    )
