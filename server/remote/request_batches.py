"""What a client asks: each question as requests, their answers as one.

`Client` carries them; there is nothing of zenoh here.
"""

import time
from collections.abc import Callable, Sequence
from typing import Any, TypeVar, Unpack

import numpy as np

from ...schemas.errors import BadRequestError, TooLargeError
from ...schemas.wire.answers import (
    CollideAnswers,
    ContactsAnswers,
    Cost,
    DistanceAnswers,
    ObjectsAnswers,
    RaycastAnswers,
    SweepAnswers,
    Verdict,
    WithinAnswers,
)
from ...schemas.wire.columns import check_answers, join, unknown
from ...schemas.wire.messages import (
    CollideRequest,
    ContactsRequest,
    DistanceRequest,
    MoveRequest,
    ObjectsRequest,
    RaycastRequest,
    SweepRequest,
    WithinRequest,
    decode_answer,
    encode,
)
from ...schemas.wire.moves import FRAME_SECONDS, Moved
from ...schemas.wire.requests import (
    QuestionOptions,
    QuestionRequest,
    is_bounded,
    make_objects,
    make_poses,
    make_vectors,
)

# Poses in one request: 512 KiB, so that one client's long list does not keep others waiting for seconds, and
# an answer comes well within the timeout.
BATCH_POSES = 4096
# The same of questions that take up to milliseconds a pose.
SLOW_BATCH = 256

_OPERATIONS: dict[type, str] = {
    CollideAnswers: "collide",
    DistanceAnswers: "distance",
    ContactsAnswers: "contacts",
    SweepAnswers: "sweep",
    RaycastAnswers: "raycast",
    WithinAnswers: "within",
    ObjectsAnswers: "objects",
}
_A = TypeVar("_A", bound=Cost)


class Questions:
    """The questions of a `Client` that have one answer each; those of a path come in parts, see `Client.path`.

    What nobody answered in time is `UNKNOWN`, never clear. Raises what the server refuses: BadRequestError,
    BadTransformError, UnknownAvatarError, BusyError and others.
    """

    def _ask_about(self, operation: str, request: bytes, names: Sequence[str]) -> bytes | None:
        """Ask about avatars of these names, in the request's order; None: nobody answered.

        Raises what an error reply says.
        """
        raise NotImplementedError

    def _note_unanswered(self, count: int) -> None:
        """Take note of so many poses, rays, points, motions or objects that nobody answered."""
        raise NotImplementedError

    def collide(
        self,
        name: str,
        poses: Any,
        margin: float = 0.0,
        **options: Unpack[QuestionOptions],
    ) -> CollideAnswers:
        """Whether an avatar touches the scene, for k poses (k, 4, 4) float64, avatar to world.

        margin: distance below which it is called contact [m].  options: here and below what every question takes:
        tolerance [m], budget_ms, budget_visits, radius_model (WIRE.md).
        """
        array = make_poses(poses)

        def request(part: slice, left: QuestionOptions) -> CollideRequest:
            return CollideRequest(name, array[part], float(margin), **left)

        return self._question(CollideAnswers, request, len(array), options, [name])

    def distance(
        self,
        name: str,
        poses: Any,
        reach: float,
        **options: Unpack[QuestionOptions],
    ) -> DistanceAnswers:
        """How far an avatar is from the scene under each of k poses, up to `reach` [m]."""
        array = make_poses(poses)

        def request(part: slice, left: QuestionOptions) -> DistanceRequest:
            return DistanceRequest(name, array[part], float(reach), **left)

        return self._question(DistanceAnswers, request, len(array), options, [name])

    def contacts(
        self,
        name: str,
        poses: Any,
        limit: int = 100,
        margin: float = 0.0,
        cluster_distance: float | None = None,
        **options: Unpack[QuestionOptions],
    ) -> ContactsAnswers:
        """Which pairs of points are in contact under each of k poses: the deepest `limit` listed, all in clusters."""
        array = make_poses(poses)

        def request(part: slice, left: QuestionOptions) -> ContactsRequest:
            return ContactsRequest(name, array[part], limit, float(margin), cluster_distance, **left)

        # A pair takes 68 bytes and its cluster up to 116: a batch's answer stays far under the largest message.
        batch = max(1, min(SLOW_BATCH, (8 << 20) // (184 * max(1, limit))))
        return self._question(ContactsAnswers, request, len(array), options, [name], batch=batch)

    def sweep(
        self,
        name: str,
        pose_from: Any,
        pose_to: Any,
        margin: float = 0.0,
        **options: Unpack[QuestionOptions],
    ) -> SweepAnswers:
        """When an avatar first touches the scene on its way from each of k poses to another."""
        begins, ends = make_poses(pose_from, "pose_from"), make_poses(pose_to, "pose_to")
        if len(begins) != len(ends):
            raise BadRequestError(
                f"{len(begins)} pose_from and {len(ends)} pose_to: expected as many of each"
            )

        def request(part: slice, left: QuestionOptions) -> SweepRequest:
            return SweepRequest(
                avatar=name, pose_from=begins[part], pose_to=ends[part], margin=float(margin), **left
            )

        return self._question(SweepAnswers, request, len(begins), options, [name], batch=SLOW_BATCH)

    def raycast(
        self,
        origins: Any,
        directions: Any,
        reach: float,
        **options: Unpack[QuestionOptions],
    ) -> RaycastAnswers:
        """Which scan point's sphere each of k rays, (k, 3) and (k, 3), hits first, up to `reach` [m]."""
        begins, towards = make_vectors(origins, "origins"), make_vectors(directions, "directions")
        if len(begins) != len(towards):
            raise BadRequestError(
                f"{len(begins)} origins and {len(towards)} directions: expected as many of each"
            )

        def request(part: slice, left: QuestionOptions) -> RaycastRequest:
            return RaycastRequest(begins[part], towards[part], float(reach), **left)

        return self._question(RaycastAnswers, request, len(begins), options)

    def within(
        self,
        points: Any,
        reach: float,
        **options: Unpack[QuestionOptions],
    ) -> WithinAnswers:
        """Which scan point is nearest to each of k loose points (k, 3), up to `reach` [m]."""
        array = make_vectors(points, "points")

        def request(part: slice, left: QuestionOptions) -> WithinRequest:
            return WithinRequest(array[part], float(reach), **left)

        return self._question(WithinAnswers, request, len(array), options)

    def objects(
        self,
        objects: Sequence[Sequence[Any]],
        margin: float = 0.0,
        **options: Unpack[QuestionOptions],
    ) -> ObjectsAnswers:
        """Which of several avatars (name, pose, group = 1, mask = all) touch the scene and one another.

        Where nobody answers, every pair is listed as `UNKNOWN`.
        """
        items, poses = make_objects(objects)

        def request(_: slice, left: QuestionOptions) -> ObjectsRequest:
            return ObjectsRequest(items, poses, float(margin), **left)

        names = [item.avatar for item in items]
        return self._question(ObjectsAnswers, request, len(items), options, names, batch=max(1, len(items)))

    def move(self, name: str, pose_from: Any, pose_to: Any, seconds: float = FRAME_SECONDS) -> Moved:
        """Where an avatar gets from one pose (1, 4, 4) towards another in a frame of so many seconds.

        By the effects that the scene calls for; nothing is remembered. What nobody answered went nowhere, `UNKNOWN`.
        """
        request = MoveRequest(
            avatar=name,
            pose_from=make_poses(pose_from, "pose_from"),
            pose_to=make_poses(pose_to, "pose_to"),
            seconds=float(seconds),
        )
        payload = self._ask_about("move", encode(request), [name])
        if payload is None:
            self._note_unanswered(1)
            way = request.pose_to[0, :3, 3] - request.pose_from[0, :3, 3]
            left = float(np.linalg.norm(way))
            return Moved(pose=request.pose_from, verdict=int(Verdict.UNKNOWN), left=left, unknown=True)
        return decode_answer(Moved, payload)

    def _question(
        self,
        kind: type[_A],
        request: Callable[[slice, QuestionOptions], QuestionRequest],
        k: int,
        options: QuestionOptions,
        names: Sequence[str] = (),
        *,
        batch: int | None = None,
    ) -> _A:
        """Ask for k answers, in several requests where they are many.

        request: makes the one for a slice, with the options that are left to it: what earlier ones took is gone from
        the budget.  names: the avatars it is about. An answer that no message holds is asked for again in smaller
        requests, but for that of `objects`, which is one.
        """
        batch = batch or BATCH_POSES
        parts: list[_A] = []
        begin = time.monotonic()
        start, budget, left = 0, options.get("budget_ms"), options
        while not parts or start < k:
            stop = min(start + batch, k)
            try:
                payload = self._ask_about(_OPERATIONS[kind], encode(request(slice(start, stop), left)), names)
            except TooLargeError:
                if stop - start <= 1 or issubclass(kind, ObjectsAnswers):
                    raise
                batch = (stop - start + 1) // 2
                continue
            finally:
                if budget is not None:
                    rest = max(0.0, budget - (time.monotonic() - begin) * 1e3)
                    left = {**options, "budget_ms": rest}
            if payload is None:
                # Not asked for the rest: a server that is frozen would cost a timeout for every batch.
                self._note_unanswered(k - start)
                parts.append(unknown(kind, k - start, bounded=is_bounded(options)))
                break
            parts.append(check_answers(decode_answer(kind, payload), stop - start))
            start = stop
        return join(parts)
