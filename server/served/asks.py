"""The query methods of `Scene` and `Client`. Both implement `ask`, to which each method passes its arguments."""

from collections.abc import Sequence
from typing import Any, TypeVar, Unpack

from ...schemas.wire.answers import (
    CollideAnswers,
    ContactsAnswers,
    Cost,
    DistanceAnswers,
    ObjectsAnswers,
    RaycastAnswers,
    SweepAnswers,
    WithinAnswers,
)
from ...schemas.wire.questions import (
    COLLIDE,
    CONTACTS,
    DISTANCE,
    OBJECTS,
    RAYCAST,
    SWEEP,
    WITHIN,
    Question,
)
from ...schemas.wire.requests import QuestionOptions
from ..runtime.stop_flag import Stop

A = TypeVar("A", bound=Cost)


class AskOptions(QuestionOptions, total=False):
    """Options of the query methods.

    Those of every question; and of a `Scene`, client: whose avatar it is; stop: ends the work early.
    """

    client: str
    stop: Stop


class Asks:
    """The questions that have one answer each.

    name: of an avatar.  poses: (k, 4, 4) float64, avatar to world.  margin: distance below which two spheres count as
    in contact [m].  reach: farthest distance worth reporting [m].
    options: what every question takes: tolerance [m], budget_ms, budget_visits, radius_model (WIRE.md).
    """

    def ask(self, question: Question[A], *arguments: Any, **options: Any) -> A:
        """Ask a question. arguments: what its request has, in the same order; options may follow by name."""
        raise NotImplementedError

    def collide(
        self, name: str, poses: Any, margin: float = 0.0, **options: Unpack[AskOptions]
    ) -> CollideAnswers:
        """Test for k poses if an avatar touches the scene."""
        return self.ask(COLLIDE, name, poses, margin, **options)

    def distance(self, name: str, poses: Any, reach: float, **options: Unpack[AskOptions]) -> DistanceAnswers:
        """Measure for k poses the distance from an avatar to the scene, up to `reach`."""
        return self.ask(DISTANCE, name, poses, reach, **options)

    def contacts(
        self,
        name: str,
        poses: Any,
        limit: int = 100,
        margin: float = 0.0,
        cluster_distance: float | None = None,
        **options: Unpack[AskOptions],
    ) -> ContactsAnswers:
        """List for k poses the pairs of points in contact: the deepest `limit` of each pose, and all clusters."""
        return self.ask(CONTACTS, name, poses, limit, margin, cluster_distance, **options)

    def sweep(
        self,
        name: str,
        pose_from: Any,
        pose_to: Any,
        margin: float = 0.0,
        **options: Unpack[AskOptions],
    ) -> SweepAnswers:
        """Find the first contact of an avatar with the scene on its way from each of k poses to another."""
        return self.ask(SWEEP, name, pose_from, pose_to, margin, **options)

    def raycast(
        self, origins: Any, directions: Any, reach: float, **options: Unpack[AskOptions]
    ) -> RaycastAnswers:
        """Find the scan point whose sphere each of k rays, (k, 3) and (k, 3), hits first, up to `reach`."""
        return self.ask(RAYCAST, origins, directions, reach, **options)

    def within(self, points: Any, reach: float, **options: Unpack[AskOptions]) -> WithinAnswers:
        """Find the scan point nearest to each of k points (k, 3), up to `reach`."""
        return self.ask(WITHIN, points, reach, **options)

    def objects(
        self,
        objects: Sequence[Sequence[Any]],
        margin: float = 0.0,
        **options: Unpack[AskOptions],
    ) -> ObjectsAnswers:
        """Test which of several avatars (name, pose, group = 1, mask = all) touch the scene and one another."""
        return self.ask(OBJECTS, objects, margin, **options)
