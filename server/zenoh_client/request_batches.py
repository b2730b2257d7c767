"""What a client asks: each question as requests, their answers as one.

`Client` carries them; there is nothing of zenoh here.
"""

import time
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np

from ...schemas.errors import TooLargeError
from ...schemas.wire.answers import Cost, Verdict
from ...schemas.wire.encoding import decode_answer, encode
from ...schemas.wire.motion_messages import FRAME_SECONDS, Moved, MoveRequest
from ...schemas.wire.question_rules import (
    Question,
    check_answers,
    join_answers,
    make_unknown,
    request_fields,
)
from ...schemas.wire.requests import has_tolerance_or_budget, make_poses
from ..scene_interface import QueryMethods

# Poses in one request: 512 KiB, so that one client's long list does not keep others waiting for seconds, and
# an answer comes well within the timeout.
BATCH_POSES = 4096
# The same of questions that take up to milliseconds a pose.
SLOW_BATCH = 256

# The answer of a batch stays far under the largest message.
_BATCH_BYTES = 8 << 20

_A = TypeVar("_A", bound=Cost)


class BatchedQueries(QueryMethods):
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

    def ask(self, question: Question[_A], *arguments: Any, **options: Any) -> _A:
        """Ask a question, in several requests where it is about many items.

        What nobody answers is `UNKNOWN`; of `objects`, every pair is listed then.
        """
        fields = request_fields(question, arguments, options)
        return self._in_batches(question, fields, options)

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

    def _in_batches(
        self, question: Question[_A], fields: Mapping[str, Any], options: Mapping[str, Any]
    ) -> _A:
        """Ask for all answers, in several requests where they are many.

        fields: those of the request for all items.  options: what every question takes; what earlier requests took is
        gone from the budget of later ones. An answer that no message holds is asked for again in smaller requests,
        unless all items are asked about together.
        """
        k, arrays = len(fields[question.counted]), question.arrays
        batch = SLOW_BATCH if question.slow else BATCH_POSES
        batch = max(1, k) if question.whole else question.most_items(batch, _BATCH_BYTES, fields)
        names = [item.avatar for item in fields.get("objects", ())]
        if "avatar" in fields:
            names = [fields["avatar"]]
        parts: list[_A] = []
        begin = time.monotonic()
        start, budget, left = 0, options.get("budget_ms"), options
        while not parts or start < k:
            stop = min(start + batch, k)
            try:
                own = {name: value[start:stop] if name in arrays else value for name, value in fields.items()}
                request = question.request(**own, **left)
                payload = self._ask_about(question.name, encode(request), names)
            except TooLargeError:
                if stop - start <= 1 or question.whole:
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
                parts.append(
                    make_unknown(question.answers, k - start, bounded=has_tolerance_or_budget(options))
                )
                break
            parts.append(check_answers(decode_answer(question.answers, payload), stop - start))
            start = stop
        return join_answers(parts)
