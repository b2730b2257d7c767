"""Effect `proximity`: report the nearest scan point and the contact normal.

It reports in each frame, for haptics and warnings. Distances are from the scan only, not from users
or dynamic objects.
"""

from typing import Any

from ....schemas.scene.effect_table import Proximity
from ....schemas.wire.motion_messages import ProximityReport
from ..world.frame import Frame
from ..world.separation_cache import nearest


def make(effect: Proximity, world: Any) -> "ProximityRunner":
    """Create the effect of a scene."""
    return ProximityRunner(effect.reach)


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
