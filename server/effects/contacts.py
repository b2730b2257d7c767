"""`contacts`: what the avatar touches, or nearly, each frame: in clusters, the deepest first.

Of the scene as scanned; users and dynamic objects are not in it.
"""

from collections.abc import Iterator
from typing import Any

from ...schemas.answers import ContactsAnswers
from ...schemas.effects import Contacts
from ...schemas.moves import ContactCluster, ContactsReport
from .apart import farther
from .frame import Frame


def make(effect: Contacts, world: Any) -> "ContactsRunner":
    """The effect of a scene."""
    return ContactsRunner(effect)


class ContactsRunner:
    """Reports the clusters of `contacts` at the frame's pose; its pairs are counted, not listed."""

    name = "contacts"

    def __init__(self, effect: Contacts) -> None:
        """effect: as declared."""
        self._effect = effect

    def run(self, frame: Frame) -> None:
        """Look, and report."""
        frame.reports[self.name] = self._report(frame)

    def _report(self, frame: Frame) -> ContactsReport:
        """What is to be said. Where not all in reach could be looked at, what was found, and `unknown`."""
        effect = self._effect
        # Nothing is in contact in most frames; to know that takes a fifth of what it takes to gather nothing.
        if farther(frame, effect.margin):
            return ContactsReport()
        of_archives = frame.world.contacts(
            frame.body.avatar, frame.pose, 0, effect.margin, effect.cluster_distance, effort=frame.effort
        )
        clusters = [cluster for answers in of_archives for cluster in _clusters(answers)]
        if len(of_archives) > 1:
            clusters.sort(key=lambda cluster: cluster.deepest)
        exact = all(answers.exact[0] for answers in of_archives)
        return ContactsReport(clusters[: effect.limit], len(clusters), not exact)


def _clusters(answers: ContactsAnswers) -> Iterator[ContactCluster]:
    """Those of one archive, deepest first."""
    columns = (
        answers.cluster_count, answers.cluster_deepest, answers.cluster_avatar, answers.cluster_cloud
    )  # fmt: skip
    for count, deepest, avatar, cloud in zip(*(column.tolist() for column in columns), strict=True):
        yield ContactCluster(count, deepest, tuple(avatar), tuple(cloud))
