"""Effect `contacts`: report the clusters of contacts within a margin, deepest first.

It reports in each frame. Contacts are with the scan only, not with users or dynamic objects.
"""

from collections.abc import Iterator
from typing import Any

from ....schemas.scene.effect_table import Contacts
from ....schemas.wire.answers import ContactsAnswers
from ....schemas.wire.motion_messages import ContactCluster, ContactsReport
from ..world.frame import Frame
from ..world.separation_cache import scene_is_farther_than


def make(effect: Contacts, world: Any) -> "ContactsRunner":
    """Create the effect of a scene."""
    return ContactsRunner(effect)


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
        of_archives = frame.world.contacts(
            frame.body.avatar, frame.pose, 0, effect.margin, effect.cluster_distance, budget=frame.budget
        )
        clusters = [cluster for answers in of_archives for cluster in _clusters(answers)]
        if len(of_archives) > 1:
            clusters.sort(key=lambda cluster: (cluster.deepest, cluster.cloud, cluster.avatar))
        exact = all(answers.exact[0] for answers in of_archives)
        return ContactsReport(clusters[: effect.limit], len(clusters), not exact)


def _clusters(answers: ContactsAnswers) -> Iterator[ContactCluster]:
    """Yield the clusters of one archive, deepest first."""
    columns = (
        answers.cluster_count, answers.cluster_deepest, answers.cluster_avatar, answers.cluster_cloud
    )  # fmt: skip
    for count, deepest, avatar, cloud in zip(*(column.tolist() for column in columns), strict=True):
        yield ContactCluster(count, deepest, tuple(avatar), tuple(cloud))
