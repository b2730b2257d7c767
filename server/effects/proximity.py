"""`proximity`: how near the nearest scan point is, where, and the way out, each frame: for haptics and warnings.

Of the scene as scanned; users and dynamic objects are not in it.
"""

from typing import Any

from ...schemas.effects import Proximity
from ...schemas.moves import ProximityReport
from .apart import nearest
from .frame import Frame


def make(effect: Proximity, world: Any) -> "ProximityRunner":
    """The effect of a scene."""
    return ProximityRunner(effect.reach)


class ProximityRunner:
    """Reports what `distance` answers at the frame's pose, with witnesses where something is within reach."""

    name = "proximity"

    def __init__(self, reach: float) -> None:
        """reach: farthest worth saying [m]."""
        self._reach = reach

    def run(self, frame: Frame) -> None:
        """Look, and report."""
        frame.reports[self.name] = self._report(frame)

    def _report(self, frame: Frame) -> ProximityReport:
        """What is to be said. Where not all in reach could be looked at, of the nearest pair known, and `unknown`."""
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
