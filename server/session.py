"""One walker: an avatar that is asked about pose after pose, and what is remembered between them."""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..schemas.answers import CollideAnswers
from .avatar import AvatarModel
from .collide import collide
from .effort import EXACT, NO_LIMIT, Effort
from .kernels.memory import KNOWN, make_memory
from .kernels.walking import walk_poses, walk_resident
from .neighbourhood import User
from .proving import find_proved_reach
from .request import SceneData, kernel_poses, refuse, to_units, with_stop
from .spent import Spent
from .stop import NEVER, Stop
from .stopped_answers import ask_until_stopped


class Readable(Protocol):
    """An archive opened, as server/opened.py has it."""

    number: int
    radius_model: Callable[[str | None], SceneData]

    def saw(self, user: User, avatar: AvatarModel, poses: Any, other: float) -> bool: ...


class Walker:
    """`collide` for poses that follow one another, each looked at with what is known of the one before.

    The verdicts are those of `collide`, whatever the poses; the closer they are, the faster. Not thread-safe. For an
    avatar of more leaf nodes than a front holds (some 8,000 points), for a scene of which scans were left out, and
    where not all voxels in reach of one call can be read and held at once, nothing is remembered and `collide` answers.
    After a reload it goes on, and what it remembers is dropped.
    """

    def __init__(
        self,
        take: Callable[[], AbstractContextManager[Readable]],
        avatar: AvatarModel,
        margin: float = 0.0,
        radius_model: str | None = None,
        user: User | None = None,
    ) -> None:
        """take: the archive that is current, held for a `with`.  margin: distance below or at which two spheres are
        called in contact [m].  user: around whom voxels are loaded before they are asked for; None: nobody. Raises
        BadRequestError, also for a radius model that the archive does not hold."""
        self._take, self._avatar, self._margin, self._model = take, avatar, margin, radius_model
        self._user = user
        self._margin_units = to_units(margin, "margin")
        front = avatar.arrays.front.shape[1]
        leaves = avatar.arrays.first[avatar.arrays.front_first :]
        self._front = front > 0 and bool((leaves < 0).all())
        self._memory = make_memory(front)
        with take() as opened:
            opened.radius_model(radius_model)
            self._number = (
                opened.number
            )  # not the archive itself: who is idle must not keep an old one in memory

    def forget(self) -> None:
        """Start afresh."""
        self._memory.state[KNOWN] = 0.0

    def collide(self, poses: ArrayLike, stop: Stop = NEVER) -> CollideAnswers:
        """Whether the avatar touches the scene under each of the poses (k, 4, 4), in their order; see `collide`.

        stop: ends the work early once it is set; what was not reached then is unknown.
        """
        begin = time.perf_counter()
        array = kernel_poses(poses)
        with self._take() as opened:
            if opened.number != self._number:
                self.forget()
                self._number = opened.number
            if self._user is not None:
                opened.saw(self._user, self._avatar, array, self._margin)
            effort, data = EXACT._replace(stop=stop), with_stop(opened.radius_model(self._model), stop)
            return ask_until_stopped(
                collide, len(array), effort, lambda: self._collide(data, array, effort, begin)
            )

    def _collide(
        self, data: SceneData, poses: NDArray[np.float64], effort: Effort, begin: float
    ) -> CollideAnswers:
        """`collide` of the archive that is current."""
        if not self._front or data.nothing_clear or len(data.unknown):
            return collide(data, self._avatar, poses, self._margin, effort)
        if len(poses) == 1:
            answers = self._collide_at_once(data, poses, begin)
            if answers is not None:
                return answers
        residency, spent = data.residency, Spent(begin)
        units = data.radius_units + self._margin_units
        reach = find_proved_reach(data, self._avatar, poses, units, effort, spent)
        rows = np.unique(reach.rows[: reach.starts[-1]]).tolist()
        if residency.bytes_of(rows) > residency.buffer.total_bytes:
            return self._collide_afresh(data, poses, effort)
        verdict, counts = np.zeros(len(poses), np.uint8), np.zeros((3, len(poses)), np.uint32)
        with residency.hold(rows, stop=effort.stop) as held:
            if not held.faults and not held.late:
                walk_poses(
                    poses, self._avatar.arrays, data.arrays, reach, NO_LIMIT, verdict, counts, self._memory
                )
        if held.faults or held.late or data.nothing_clear:
            return self._collide_afresh(data, poses, effort)
        spent.add(held)
        return CollideAnswers(verdict, reach.outside, counts[0], counts[1], counts[2], **spent.cost(data))

    def _collide_at_once(
        self, data: SceneData, poses: NDArray[np.float64], begin: float
    ) -> CollideAnswers | None:
        """Answer one pose in one kernel call, as collide.py does; None: not all it needs is resident."""
        avatar, residency = self._avatar, data.residency
        units = data.radius_units + self._margin_units
        rows, outside = np.empty(64, np.int64), np.zeros(1, bool)
        verdict, counts = np.zeros(1, np.uint8), np.zeros((3, 1), np.uint32)
        with residency.still():
            fault, pose, found, needed = walk_resident(
                poses, avatar.arrays, avatar.radius, units, data.arrays, data.broad, rows, outside, verdict,
                counts, self._memory,
            )  # fmt: skip
            if needed > 0:
                residency.use(rows[:needed].tolist())
        refuse(fault, pose, found)
        if needed < 0:
            return None
        return CollideAnswers(
            verdict, outside, counts[0], counts[1], counts[2], engine_seconds=time.perf_counter() - begin,
            hits=needed, resident=residency.resident, resident_bytes=residency.resident_bytes,
        )  # fmt: skip

    def _collide_afresh(self, data: SceneData, poses: NDArray[np.float64], effort: Effort) -> CollideAnswers:
        """Answer without memory, and keep none."""
        self.forget()
        return collide(data, self._avatar, poses, self._margin, effort)
