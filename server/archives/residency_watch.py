"""What is resident of a scene: the answer of `stats`, and the changes as they happen.

A log (`ChangeLog`) collects the changes of each archive under its cache's lock. A
reader takes them at its own rate, so no load or eviction waits for a reader.
"""

import threading
from collections.abc import Iterator, Sequence
from time import monotonic
from typing import Self

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError
from ...schemas.wire.residency_messages import (
    CHANGES_SECONDS,
    MAX_CHANGED_VOXELS,
    SILENT_SECONDS,
    ResidencyChanges,
)
from ...schemas.wire.stats import AvatarStats, Counters, StatsAnswer
from ..observability.request_stats import RequestStats, times_of
from ..residency.voxel_cache import ChangeLog
from .placed_archive import ArchiveGeneration, PlacedArchive


def make_stats(
    name: str,
    each: Sequence[ArchiveGeneration],
    metrics: RequestStats,
    avatars: AvatarStats,
    *,
    keys: bool = False,
) -> StatsAnswer:
    """Return cache statistics summed over the archives of a scene, and its request statistics.

    metrics: the requests answered so far.  avatars: statistics of the clients' avatars.
    keys: also list the resident voxels, each by its key in its own archive.
    """
    total, users = metrics.snapshot()
    counts = total.counts
    residencies = [opened.data.residency for opened in each]
    level_bytes = sum(opened.level.residency.budget_bytes for opened in each if opened.level)
    counters = [structs.asdict(residency.counters()) for residency in residencies]
    loads = [seconds for residency in residencies for seconds in residency.load_times()]
    return StatsAnswer(
        scene=name,
        generation=sum(opened.store.archive.header.generation for opened in each),
        policy=residencies[0].policy.name,
        budget_bytes=sum(residency.budget_bytes for residency in residencies) + level_bytes,
        resident_bytes=sum(residency.resident_bytes for residency in residencies),
        level_bytes=level_bytes,
        voxels=sum(len(opened.store.sizes) for opened in each),
        resident=sum(residency.resident for residency in residencies),
        kept=sum(len(residency.kept) for residency in residencies),
        requests=counts.requests,
        answers=counts.answers,
        unknown=counts.unknown,
        waited=counts.waited,
        load_seconds=times_of(loads, total.loads.times()),
        stall_seconds=counts.stalls.times(),
        engine_seconds=total.engine.times(),
        users=users,
        keys=sorted(key for opened in each for key in _resident_keys(opened)) if keys else None,
        avatars=avatars,
        **{field: sum(own[field] for own in counters) for field in Counters.__struct_fields__},
    )


def _resident_keys(opened: ArchiveGeneration) -> list[int]:
    """Return the keys of an archive's resident voxels."""
    rows = np.flatnonzero(opened.data.residency.where[:, 0] >= 0)
    keys: list[int] = opened.store.archive.voxels["key"][rows].tolist()
    return keys


class ResidencyWatch:
    """Changes of a scene since this was made; a context manager, thread-safe.

    Made by `Scene.residency_changes`. Iterating over it yields the messages of `changes`.
    """

    def __init__(self, archives: Sequence[PlacedArchive]) -> None:
        """Begin to follow archives. Raise BadRequestError if the scene is closed."""
        self._archives = archives
        # For each archive, the number of the generation that is followed, which this does not keep in
        # memory, and the log of its cache.
        self._followed: list[tuple[int, ChangeLog] | None] = [None] * len(archives)
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._seq, self._said = 0, 0.0
        for number, archive in enumerate(archives):
            with archive.take() as opened:
                self._followed[number] = opened.number, opened.data.residency.follow()
        self._lost = True  # the first message is the beginning

    def __enter__(self) -> Self:
        """Return the watch itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """End following."""
        self.close()

    def close(self) -> None:
        """End following; `changes` ends. Closing twice is allowed."""
        self._closed.set()
        with self._lock:
            self._followed = [None] * len(self._archives)

    def __iter__(self) -> Iterator[ResidencyChanges]:
        """Yield the messages of `changes`."""
        return self.changes()

    def changes(self, timeout: float = 5.0) -> Iterator[ResidencyChanges]:
        """Yield changes in order, at least one message every half second, until this is closed.

        timeout: as in `Client.residency_changes`; a scene of this process always answers.
        """
        while not self._closed.is_set():
            try:
                message = self.take()
            except BadRequestError:  # the scene was closed
                return
            if message is not None:
                yield message
            self._closed.wait(CHANGES_SECONDS)

    def take(self, *, always: bool = False) -> ResidencyChanges | None:
        """Return the changes since the last message; None if there is nothing to say yet.

        always: return a message without changes too. Raise BadRequestError if the scene is closed.
        """
        with self._lock:
            states: list[int] = []
            archives: list[int] = []
            voxels: list[NDArray[np.int32]] = []
            lost, resident, resident_bytes = self._lost, 0, 0
            for number, archive in enumerate(self._archives):
                with archive.take() as opened:
                    followed, cache = self._followed[number], opened.data.residency
                    if followed is None or followed[0] != opened.number:
                        followed, lost = (opened.number, cache.follow()), True
                        self._followed[number] = followed
                    changes, overflowed = cache.take_changes(followed[1])
                    lost |= overflowed
                    resident += cache.resident
                    resident_bytes += cache.resident_bytes
                    room = MAX_CHANGED_VOXELS - len(states)
                    if len(changes) > room:
                        changes, lost = dict(list(changes.items())[:room]), True
                    if changes:
                        states += changes.values()
                        archives += [number] * len(changes)
                        voxels.append(opened.store.archive.coordinates[list(changes)].astype(np.int32))
            now = monotonic()
            if not (always or states or lost or now - self._said >= SILENT_SECONDS):
                return None
            self._seq += 1
            self._said, self._lost = now, False
            return ResidencyChanges(
                self._seq,
                lost,
                np.array(archives, np.uint16),
                np.concatenate([np.empty((0, 3), np.int32), *voxels]),
                np.array(states, np.uint8),
                resident,
                resident_bytes,
            )
