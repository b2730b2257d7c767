"""Effects `proximity` and `contacts`, and the separation that all reporting effects share.

`proximity` reports the nearest scan point and the contact normal, for haptics and warnings; `contacts`
the clusters of contacts within a margin, deepest first. They report in each frame, of the scan only,
not of users or dynamic objects.

Separation of an avatar from the scene, queried once a frame for all reporting effects.

The result is cached. A result at one pose bounds the separation at the next: it decreases by at
most the distance that the avatar's spheres moved. If the bound exceeds the distance that an effect
needs, no search runs. A cached result remains valid even if the frame that found it is discarded.
The cache changes no answer, only its cost. If a budget is too small for a search, the cache may
therefore decide whether the separation is known.
"""

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from ....schemas.errors import SolidcloudError
from ....schemas.scene.effect_table import Contacts, Proximity
from ....schemas.wire.answers import ContactsAnswers, DistanceAnswers
from ....schemas.wire.motion_messages import ContactCluster, ContactsReport, ProximityReport
from ...avatars.avatar_model import AvatarModel
from ..world.frame import Frame

CACHE_KEY = "separation"
# If nothing was in reach so far, a search extends farther by this distance, or to twice the reach
# if that is less [m]. The extra cost saves the searches of later frames, until the avatar has moved
# that distance.
EXTRA_REACH = 1.0
# Distances are rounded, and reaches are rounded to exact units of 15 nm. Below this difference,
# only a search decides [m].
ROUNDING = 1e-7
# Largest error of placing a point, at 1e9 m from the origin [m].
PLACEMENT_ERROR = 1e-5

Rows = list[list[float]]


class CachedSeparation(NamedTuple):
    """Exact result at one pose.

    generations: of the world's archives; the result does not apply to others.
    rows: the pose.  searched_reach: reach of the search [m].  answers: of `distance`.
    """

    world: Any
    generations: tuple[int, ...]
    avatar: AvatarModel
    rows: Rows
    searched_reach: float
    answers: DistanceAnswers


def displacement_bound(before: Rows, now: Rows, avatar: AvatarModel) -> float:
    """Return an upper bound of the distance that any point of the avatar's spheres moved [m].

    avatar: not empty.
    """
    x, y, z = avatar.arrays.center[0].tolist()
    shift = turn = 0.0
    for (a, b, c, t), (d, e, f, u) in zip(before[:3], now[:3], strict=True):
        a, b, c = d - a, e - b, f - c
        turn += a * a + b * b + c * c
        shift += (a * x + b * y + c * z + (u - t)) ** 2
    return (math.sqrt(shift) + math.sqrt(turn) * avatar.bounding_radius) * (1.0 + 1e-9) + PLACEMENT_ERROR


def nearest(frame: Frame, reach: float) -> DistanceAnswers | None:
    """Return the answer of `distance` at the frame's pose for `reach` or farther.

    None: certainly nothing is within reach. An answer that is not exact means that a voxel in reach
    is missing, or the frame's budget is spent.
    """
    body, world = frame.body, frame.world
    avatar, rows = body.avatar, frame.pose.tolist()
    generations = world.generations()
    known: CachedSeparation | None = body.effect_state.get(CACHE_KEY)
    if (
        known is not None
        and known.world is world
        and known.generations == generations
        and known.avatar is avatar
    ):
        at_least = float(known.answers.lower[0])
        if known.rows == rows:
            if known.searched_reach == reach or (
                known.searched_reach > reach and abs(at_least - reach) > ROUNDING
            ):
                return known.answers
        elif at_least - displacement_bound(known.rows, rows, avatar) > reach + ROUNDING:
            return None
        if at_least >= reach > ROUNDING:  # with no reach, twice the reach is no farther
            searched_reach = reach + min(reach, EXTRA_REACH)
            ahead = _search_farther(frame, reach, searched_reach)
            if ahead is not None:
                body.effect_state[CACHE_KEY] = CachedSeparation(
                    world, generations, avatar, rows, searched_reach, ahead
                )
                return ahead
    answers: DistanceAnswers = world.distance(avatar, frame.pose, reach, budget=frame.budget)
    if answers.exact[0] and len(avatar.points):
        body.effect_state[CACHE_KEY] = CachedSeparation(world, generations, avatar, rows, reach, answers)
    else:
        body.effect_state.pop(CACHE_KEY, None)
    return answers


def _search_farther(frame: Frame, reach: float, searched_reach: float) -> DistanceAnswers | None:
    """Search up to `searched_reach`; return the answer if it also holds for `reach`, else None."""
    try:
        answers: DistanceAnswers = frame.world.distance(
            frame.body.avatar, frame.pose, searched_reach, budget=frame.budget
        )
    except SolidcloudError:  # this reach exceeds the limits; `reach` may not exceed them
        return None
    # A voxel that is missing beyond `reach` must not make the answer less certain.
    return answers if answers.exact[0] and abs(answers.lower[0] - reach) > ROUNDING else None


def is_farther_than(answers: DistanceAnswers | None, metres: float) -> bool:
    """Return whether an answer of `nearest` proves that the spheres are over `metres` apart."""
    return answers is None or bool(answers.exact[0] and answers.signed_distance[0] > metres + ROUNDING)


def scene_is_farther_than(frame: Frame, metres: float) -> bool:
    """Return whether the avatar is provably more than `metres` from the scene.

    The distance is that of its spheres from all spheres of the scan.
    """
    return is_farther_than(nearest(frame, metres), metres)


class ProximityRunner:
    """Effect that reports the answer of `distance` at the frame's pose.

    The report has witnesses if something is within reach.
    """

    name = "proximity"

    def __init__(self, reach: float) -> None:
        """Create the effect. reach: largest distance to report [m]."""
        self._reach = reach

    def run(self, frame: Frame) -> None:
        """Search, and write the report."""
        frame.reports[self.name] = self._report(frame)

    def _report(self, frame: Frame) -> ProximityReport:
        """Return the report; after an incomplete search, the nearest pair known, with `unknown`."""
        answers = nearest(frame, self._reach)
        if answers is None:
            return ProximityReport()
        distance, unknown = float(answers.signed_distance[0]), not answers.exact[0]
        if distance > self._reach:
            return ProximityReport(unknown=unknown)
        avatar, cloud, normal = (
            column[0].tolist() for column in (answers.witness_avatar, answers.witness_cloud, answers.normal)
        )
        return ProximityReport(distance, tuple(avatar), tuple(cloud), tuple(normal), unknown)


class ContactsRunner:
    """Effect that reports the clusters of `contacts` at the frame's pose.

    Its pairs are counted, not listed.
    """

    name = "contacts"

    def __init__(self, effect: Contacts) -> None:
        """Create the effect as declared."""
        self._effect = effect

    def run(self, frame: Frame) -> None:
        """Search, and write the report."""
        frame.reports[self.name] = self._report(frame)

    def _report(self, frame: Frame) -> ContactsReport:
        """Return the report; after an incomplete search, the contacts found, with `unknown`."""
        effect = self._effect
        # Most frames have no contact. This test takes a fifth of the time of an empty `contacts`.
        if scene_is_farther_than(frame, effect.margin):
            return ContactsReport()
        answers = frame.world.contacts(
            frame.body.avatar, frame.pose, 0, effect.margin, effect.cluster_distance, budget=frame.budget
        )
        clusters = list(_clusters(answers))
        return ContactsReport(clusters[: effect.limit], len(clusters), not answers.exact[0])


def _clusters(answers: ContactsAnswers) -> Iterator[ContactCluster]:
    """Yield the clusters, deepest first."""
    columns = (
        answers.cluster_count, answers.cluster_deepest, answers.cluster_avatar, answers.cluster_cloud
    )  # fmt: skip
    for count, deepest, avatar, cloud in zip(*(column.tolist() for column in columns), strict=True):
        yield ContactCluster(count, deepest, tuple(avatar), tuple(cloud))


def make(effect: Proximity | Contacts, world: Any) -> ProximityRunner | ContactsRunner:
    """Create an effect of a scene."""
    return ProximityRunner(effect.reach) if isinstance(effect, Proximity) else ContactsRunner(effect)
