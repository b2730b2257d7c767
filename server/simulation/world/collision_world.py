"""Collision world: the archives of a scene as one, queried by effects for one avatar at a time.

A frame asks as a request of one pose does (server/archives/ask_archives.py): each archive is queried
in its own frame, and the answers are merged. The world adds what a frame keeps: the archive
generations that it holds, the cost of its queries, and whether an answer was incomplete.
"""

import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.errors import CorruptError
from ....schemas.scene.scene_file import SceneFile
from ....schemas.wire.answers import (
    CollideAnswers,
    ContactsAnswers,
    DistanceAnswers,
    SweepAnswers,
    Verdict,
    WithinAnswers,
)
from ...archives.ask_archives import HeldArchive, ask_held, hold_archives, release
from ...archives.merge_answers import merge_answers
from ...archives.placed_archive import PlacedArchive
from ...archives.rigid_transform import rotate_vectors, transform_points
from ...avatars.avatar_model import AvatarModel
from ...kernels.core.normal_codes import MAX_NORMAL_REACH
from ...kernels.motion.sweep_resident import pose_between
from ...queries.collide import collide_fast
from ...queries.contacts import contacts
from ...queries.distance import distance_fast
from ...queries.query_inputs import EXACT, QueryBudget, has_unknown
from ...queries.rays_and_points import within
from ...queries.sweep import sweep_fast
from ...runtime.stop_flag import NO_STOP, StopFlag, StoppedError
from ...scene_interface import EVERYBODY
from .frame import Hit, Pose, Vec, min_height, unit_vector

_Answers = TypeVar("_Answers", CollideAnswers, ContactsAnswers, DistanceAnswers, SweepAnswers, WithinAnswers)

_NO_ORIGIN = np.zeros(3)
# If the points near a touched one form no surface, because the scan is sparse, the reach of its
# normal is multiplied by this factor.
SPARSE_FACTOR = 3.0
# `Verdict` of its number: making one takes as long as a fifth of a query.
VERDICTS = {int(verdict): verdict for verdict in Verdict}
_CLEAR, _UNKNOWN = int(Verdict.CLEAR), int(Verdict.UNKNOWN)


class _Held(threading.local):
    """State of one thread: the archives it holds, and the frame's stop flag and cost."""

    depth = 0
    visits = 0
    stop: StopFlag = NO_STOP
    unknown = False
    archives: Sequence[HeldArchive] = ()


class World:
    """Collision world of one scene. Thread-safe.

    file: the scene file.  up: (3,) unit vector against gravity.  archives: of the scene.
    is_alone: whether it is a single archive at the identity.
    walker: see `walker_of` in walker.py.  bodies: see `bodies_of` in body_effects.py.
    """

    walker: Any = None
    bodies: Any = None

    def __init__(self, scene: Any, file: SceneFile) -> None:
        """Create the world of a scene, an object with `archives` and `avatar` such as `Scene`."""
        self.file, self._scene = file, scene
        self.up: Vec = unit_vector(file.up)
        self.archives: list[PlacedArchive] = list(scene.archives)
        self.is_alone = len(self.archives) == 1 and self.archives[0].pose is None
        self._held = _Held()

    def __enter__(self) -> Sequence[HeldArchive]:
        """Hold the current archive generations, which this thread queries inside the `with`."""
        held = self._held
        if not held.depth:
            held.archives = hold_archives(self.archives, self.file.radius_model, held.stop)
        held.depth += 1
        return held.archives

    def __exit__(self, *_: object) -> None:
        """Release the archives."""
        held = self._held
        held.depth -= 1
        if not held.depth:
            archives, held.archives = held.archives, ()
            release(archives)

    def begin(self, stop: StopFlag) -> None:
        """Begin a frame of this thread. stop: flag for its queries from the next hold on."""
        self._held.stop, self._held.unknown = stop, False

    @property
    def unknown(self) -> bool:
        """Return whether a query of this thread's frame was incomplete."""
        return self._held.unknown

    @property
    def visits(self) -> int:
        """Return the node visits of all queries of this thread."""
        return self._held.visits

    def count(self, visits: int, missing: int = 0) -> None:
        """Add the cost of a query of this thread.

        visits: of nodes.  missing: number of voxels that were not available.
        """
        self._held.visits += visits
        if missing:
            self._held.unknown = True

    def avatar(self, name: str) -> AvatarModel:
        """Return an avatar of the scene file. Raise UnknownAvatarError."""
        model: AvatarModel = self._scene.avatar(name, EVERYBODY)
        return model

    def generations(self) -> tuple[int, ...]:
        """Return the generation numbers of the current archives, which a reload changes."""
        with self as held:
            return tuple([each.opened.number for each in held])

    def saw(self, user: tuple[str, str], avatar: AvatarModel, pose: Pose, around: float = 0.0) -> None:
        """Record a user's pose, around which voxels are prefetched. Call it inside a `with`.

        around: distance beyond the avatar's spheres [m].
        """
        for each in self._held.archives:
            each.opened.record_user(user, avatar, each.placed.poses_in(pose[None]), around)

    def lowest_height(self) -> float:
        """Return the height of the lowest corner of the archives' boxes, spheres included [m]."""
        least = np.inf
        with self as held:
            for each in held:
                arrays, radius = each.data.arrays, each.data.radius_units / UNITS_PER_METRE
                box = each.data.tree.scene * arrays.step + arrays.origin
                corners = np.stack(np.meshgrid(*box.T), axis=-1).reshape(-1, 3)
                if each.placed.pose is not None:
                    corners = transform_points(each.placed.pose, corners)
                least = min(least, min_height(corners, self.up) - radius)
        return least

    def _ask(
        self, budget: QueryBudget, ask: Callable[[HeldArchive], _Answers], *same: str
    ) -> tuple[_Answers, int]:
        """Ask each archive about one item; return the merged answers, and the archive that they name.

        ask: queries an archive, in its frame.  same: columns whose first value tells that archive.
        """
        held, number = self._held, 0
        if self.is_alone and held.depth:  # nothing to transform or to merge
            answers: Any = ask(held.archives[0])
        else:
            with self as archives:
                found: list[Any] = ask_held(archives, ask)
            answers = merge_answers(found)
            if len(found) > 1 and same:
                named = [
                    b"".join([getattr(each, name)[:1].tobytes() for name in same])
                    for each in (answers, *found)
                ]
                number = named.index(named[0], 1) - 1
        verdict, missing = answers.verdict.item(0), answers.voxels_missing.item(0)
        # A motion that the level of detail proves clear lacks nothing.
        if answers.late and not (isinstance(answers, SweepAnswers) and verdict == _CLEAR):
            budget.lacked(len(answers.late))
        held.visits += answers.node_visits.item(0)
        if verdict == _UNKNOWN or (missing and not isinstance(answers, CollideAnswers)):
            held.unknown = True
        return answers, number

    def _ask_avatar(
        self,
        engine: Callable[..., _Answers],
        avatar: AvatarModel,
        poses: tuple[Pose, ...],
        arguments: tuple[Any, ...],
        budget: QueryBudget,
        *same: str,
    ) -> tuple[_Answers, int]:
        """Ask each archive about an avatar at a pose (4, 4), or on the motion between two, as `_ask`.

        engine: of server/queries.  arguments: those between its poses and its budget.
        """

        def ask(each: HeldArchive) -> _Answers:
            placed = [each.placed.poses_in(pose[None]) for pose in poses]
            return engine(each.data, avatar, *placed, *arguments, budget)

        return self._ask(budget, ask, *same)

    def collide(self, avatar: AvatarModel, pose: Pose, budget: QueryBudget = EXACT) -> Verdict:
        """Return the verdict at a pose (4, 4) over all archives; see server/queries/collide.py."""
        answers, _ = self._ask_avatar(collide_fast, avatar, (pose,), (0.0,), budget)
        return VERDICTS[answers.verdict.item(0)]

    def distance(
        self, avatar: AvatarModel, pose: Pose, reach: float, budget: QueryBudget = EXACT
    ) -> DistanceAnswers:
        """Return the distance of the avatar from the scan at a pose; see server/queries/distance.py."""
        return self._ask_avatar(distance_fast, avatar, (pose,), (reach,), budget)[0]

    def contacts(
        self,
        avatar: AvatarModel,
        pose: Pose,
        limit: int,
        margin: float = 0.0,
        cluster_distance: float | None = None,
        budget: QueryBudget = EXACT,
    ) -> tuple[ContactsAnswers, int]:
        """Return the contacts at a pose (server/queries/contacts.py), and the archive of the deepest one.

        limit: of each archive.
        """
        arguments = limit, margin, cluster_distance
        names = "signed_distance", "cloud_point", "avatar_point"
        return self._ask_avatar(contacts, avatar, (pose,), arguments, budget, *names)

    def deepest(self, avatar: AvatarModel, pose: Pose, budget: QueryBudget = EXACT) -> Hit | None:
        """Return the deepest contact at a pose, with fraction 0, or None."""
        found, number = self.contacts(avatar, pose, 1, budget=budget)
        if not len(found.signed_distance):
            return None
        return Hit(0.0, Verdict.CONTACT, found.avatar_point[0], found.cloud_point[0], "", number)

    def nearest(self, place: Vec, reach: float, budget: QueryBudget = EXACT) -> Hit | None:
        """Return the scan point nearest to a place (3,) within `reach` [m], as a Hit; None if there is none."""
        points = place[None]
        found, number = self._ask(
            budget,
            lambda each: within(each.data, each.placed.points_in(points), reach, budget),
            "distance",
            "cloud_point",
        )
        if found.distance[0] == np.inf:
            return None
        return Hit(0.0, VERDICTS[found.verdict.item(0)], None, found.cloud_point[0], "", number)

    def sweep(
        self,
        avatar: AvatarModel,
        pose_from: Pose,
        pose_to: Pose,
        tolerance: float = 1e-6,
        budget: QueryBudget = EXACT,
    ) -> Hit | None:
        """Return the hit that ends the motion between two poses first; None if it is clear.

        See server/queries/sweep.py. Nothing is touched before the hit's fraction.
        """
        names = "upper", "witness_cloud", "witness_avatar"
        found, number = self._ask_avatar(
            sweep_fast, avatar, (pose_from, pose_to), (0.0, tolerance), budget, *names
        )
        verdict, exact = VERDICTS[found.verdict.item(0)], found.exact.item(0)
        if not exact:
            with self as held:  # a stop may leave places unexamined too
                self.count(0, bool(budget.stop) or any(has_unknown(each.data) for each in held))
        if verdict == Verdict.CLEAR:
            return None
        lower, upper = found.lower.item(0), found.upper.item(0)
        if verdict == Verdict.UNKNOWN:
            return Hit(lower, verdict, None, None, exact=exact)
        own, cloud = found.witness_avatar[0], found.witness_cloud[0]
        return Hit(lower, verdict, own, cloud, "", number, upper=upper, exact=exact)

    def between(
        self, avatar: AvatarModel, pose_from: Pose, pose_to: Pose, fraction: float
    ) -> tuple[Pose, bool]:
        """Return the pose at a fraction of a motion, and whether the proof of `sweep` covers it."""
        with self as held:
            origin = held[0].data.arrays.origin if self.is_alone else _NO_ORIGIN
        pose = np.empty((4, 4))
        ends = np.ascontiguousarray(pose_from), np.ascontiguousarray(pose_to)
        same = pose_between(*ends, fraction, avatar.box, origin, pose)
        return pose, bool(same) and self.is_alone

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

        def ask(normals: Any, place: Vec, ways: NDArray[np.float64], **how: Any) -> Vec | None:
            found: Vec | None = normals.at(place, ways[0], reach, **how)
            if found is None:
                found = normals.at(place, ways[0], min(SPARSE_FACTOR * reach, MAX_NORMAL_REACH), **how)
            return found

        found, pose = (
            self._ask_surface(archive, cloud, toward[None], budget, ask),
            self.archives[archive].pose,
        )
        return found if found is None or pose is None else rotate_vectors(pose, found[None])[0]

    def highest(
        self,
        archive: int,
        cloud: Vec,
        directions: NDArray[np.float64],
        reach: float,
        budget: QueryBudget = EXACT,
    ) -> NDArray[np.float64]:
        """Return how high the scan points around one (3,) of an archive lie along directions (k,) [m].

        directions: (k, 3) unit.  reach, budget: as for `normal`. Return 0 if a voxel within reach is
        not in memory, or cannot be read.
        """
        found = self._ask_surface(
            archive, cloud, directions, budget,
            lambda normals, place, ways, **how: normals.highest(place, ways, reach, **how),
        )  # fmt: skip
        return np.zeros(len(directions)) if found is None else found

    def _ask_surface(
        self,
        archive: int,
        cloud: Vec,
        ways: NDArray[np.float64],
        budget: QueryBudget,
        ask: Callable[..., NDArray[np.float64] | None],
    ) -> NDArray[np.float64] | None:
        """Return what `ask` says of the surface at a scan point; None if a voxel within reach is lacking.

        cloud: (3,), ways: directions (k, 3), world.  ask: takes `Normals` and these in the archive's
        frame.
        """
        held, waits = self._held, budget.late is None
        with self as archives:
            each = archives[archive]
            place, inverse = each.placed.points_in(cloud[None])[0], each.placed.inverse
            ways = ways if inverse is None else rotate_vectors(inverse, ways)
            try:
                return ask(normals_of(each), place, ways, stop=held.stop, waits=waits)
            except CorruptError:
                pass
            except StoppedError:
                if waits or held.stop:
                    raise
                budget.lacked(1)
            held.unknown = True
            return None


def normals_of(seen: HeldArchive) -> Any:
    """Return the `Normals` of an archive generation."""
    kept = seen.opened.kept
    normals = kept.get("normals")
    if normals is None:
        # Imported here: only some effects need normals.
        from ...queries.surface_normals import Normals

        normals = kept.setdefault("normals", Normals(seen.data, seen.opened.store.archive))
    return normals
