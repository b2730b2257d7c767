"""Effects `proximity` and `contacts`: reports on the scan around the pose that a frame has reached.

`proximity` reports the nearest scan point and the contact normal, for haptics and warnings; `contacts`
the clusters of contacts within a margin, deepest first. They report in each frame, of the scan only,
not of users or dynamic objects.
"""

import math
from collections.abc import Iterator
from functools import partial
from typing import Any

from ....schemas.scene.effect_table import Contacts, Proximity
from ....schemas.wire.answers import ContactsAnswers
from ....schemas.wire.motion_messages import ContactCluster, ContactsReport, ProximityReport
from ..world.frame import Frame, Run

# Distances and margins are rounded to exact units of 15 nm. Below this difference, only a search
# decides [m].
_ROUNDING = 1e-7


def make(effect: Proximity | Contacts, world: Any) -> Run:
    """Create an effect of a scene."""
    if isinstance(effect, Proximity):
        return partial(report_proximity, effect)
    return partial(report_contacts, effect)


def is_farther_than(frame: Frame, metres: float) -> bool:
    """Return whether the avatar's spheres are proved to be more than `metres` from those of the scan."""
    known: ProximityReport | None = frame.reports.get("proximity")  # which runs before
    distance = None if known is None or known.unknown else known.distance
    if distance is not None and abs(distance - metres) > _ROUNDING:
        return distance > metres
    answers = frame.world.distance(frame.body.avatar, frame.pose, metres, budget=frame.budget)
    return bool(answers.exact[0] and answers.signed_distance[0] == math.inf)


def report_proximity(effect: Proximity, frame: Frame) -> ProximityReport:
    """Return the answer of `distance` at the frame's pose, with witnesses if something is within reach.

    After an incomplete search, return the nearest pair known, with `unknown`.
    """
    answers = frame.world.distance(frame.body.avatar, frame.pose, effect.reach, budget=frame.budget)
    distance, unknown = float(answers.signed_distance[0]), not answers.exact[0]
    if distance > effect.reach:
        return ProximityReport(unknown=unknown)
    avatar, cloud, normal = (
        column[0].tolist() for column in (answers.witness_avatar, answers.witness_cloud, answers.normal)
    )
    return ProximityReport(distance, tuple(avatar), tuple(cloud), tuple(normal), unknown)


def report_contacts(effect: Contacts, frame: Frame) -> ContactsReport:
    """Return the clusters of `contacts` at the frame's pose. Its pairs are counted, not listed.

    After an incomplete search, return the contacts found, with `unknown`.
    """
    # Most frames have no contact. This test takes a fifth of the time of an empty `contacts`.
    if is_farther_than(frame, effect.margin):
        return ContactsReport()
    answers, _ = frame.world.contacts(
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
