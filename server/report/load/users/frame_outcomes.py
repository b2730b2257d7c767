"""Outcome of every frame of a run, and the figures derived from it."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .....schemas.wire.answers import Verdict
from .frame_clock import after_first, stalled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# A frame is answered, refused with an error, or unanswered.
NOTHING, ANSWERED, REFUSED = 0, 1, 2
PERCENTILES = (50.0, 99.0, 99.9, 100.0)


class Frames(NamedTuple):
    """n frames in order of their due times; times are seconds on one clock.

    user: (n,) int64.
    due, sent, done: when the request was due and sent, and its answer decoded; NaN: never.
    status: (n,) of the three above.
    verdict: (n,) int64, -1 without an answer.
    hits, misses: of the answer, voxels.
    engine, wait: time in the server's engine, and the part of it spent waiting for voxels,
    whichever request loaded them [s].
    resident_bytes: in the server, after the request.
    """

    user: Ints
    due: Floats
    sent: Floats
    done: Floats
    status: Ints
    verdict: Ints
    hits: Ints
    misses: Ints
    engine: Floats
    wait: Floats
    resident_bytes: Ints


class Figures(NamedTuple):
    """Figures of a run; times in [s].

    They cover frames after the first second of each user, except the fault counts.
    without_miss, waited: shares of the answered frames.
    hit_rate: of voxels.
    delays, waits: percentiles (PERCENTILES) of due to done, and of the wait for voxels.
    round_trips: of sent to done.
    late: 99th percentile of due to sent: the delay of the users themselves.
    rate: answers per second.
    """

    frames: int
    stalled: int
    without_miss: float
    hit_rate: float
    misses: int
    delays: Floats
    round_trips: Floats
    waits: Floats
    waited: float
    late: float
    rate: float
    unknown: int
    refused: int
    unanswered: int


def empty(user: Ints, due: Floats) -> Frames:
    """Return frames (n,) without any outcome yet."""
    n = len(user)
    return Frames(
        user, due, np.full(n, np.nan), np.full(n, np.nan), np.full(n, NOTHING), np.full(n, -1),
        np.zeros(n, np.int64), np.zeros(n, np.int64), np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, np.int64),
    )  # fmt: skip


def merged(parts: list[Frames]) -> Frames:
    """Merge the frames of several processes in order of due time; at equal times in order of users."""
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.lexsort((columns[0], columns[1]))
    return Frames(*(column[order] for column in columns))


def save(path: Path, frames: Frames, **more: NDArray) -> None:
    """Write frames and further arrays as .npz."""
    arrays: dict[str, Any] = {**frames._asdict(), **more}
    np.savez(path, **arrays)


def load(path: Path) -> tuple[Frames, dict[str, NDArray]]:
    """Read a file of `save`: the frames, and the further arrays."""
    with np.load(path, allow_pickle=False) as file:
        columns = {name: file[name] for name in file.files}
    return Frames(*(columns.pop(name) for name in Frames._fields)), columns


def percentiles(values: Floats, shares: tuple[float, ...] = PERCENTILES) -> Floats:
    """Return percentiles of the numbers among the values; NaN where there are none.

    No value is interpolated between two measurements.
    """
    known = values[np.isfinite(values)]
    if not len(known):
        return np.full(len(shares), np.nan)
    return np.percentile(known, shares, method="higher")


def figures(frames: Frames, warm_up: float = 1.0) -> Figures:
    """Return the figures of a run.

    warm_up: initial seconds of each user that count only for refused, unanswered and unknown
    frames.
    """
    kept = after_first(frames.user, frames.due, warm_up)
    answered = kept & (frames.status == ANSWERED)
    hits, misses = int(frames.hits[answered].sum()), int(frames.misses[answered].sum())
    spent = float(np.ptp(frames.due[kept])) if kept.any() else 0.0
    late = percentiles((frames.sent - frames.due)[kept], (99.0,))
    return Figures(
        frames=int(kept.sum()),
        stalled=int(stalled(frames.due, frames.done)[kept].sum()),
        without_miss=float((frames.misses[answered] == 0).mean()) if answered.any() else np.nan,
        hit_rate=hits / (hits + misses) if hits + misses else np.nan,
        misses=misses,
        delays=percentiles((frames.done - frames.due)[kept]),
        round_trips=percentiles((frames.done - frames.sent)[kept]),
        waits=percentiles(frames.wait[kept]),
        waited=float((frames.wait[answered] > 0).mean()) if answered.any() else np.nan,
        late=float(late[0]),
        rate=float(answered.sum()) / spent if spent else np.nan,
        unknown=int((frames.verdict == Verdict.UNKNOWN).sum()),
        refused=int((frames.status == REFUSED).sum()),
        unanswered=int((frames.status == NOTHING).sum()),
    )


def bytes_over_time(frames: Frames, pieces: int = 200) -> tuple[Floats, Floats]:
    """Return the most resident bytes that answers report in each of `pieces` parts of the run.

    Returns (times from its start [s], bytes).
    """
    answered = frames.status == ANSWERED
    if not answered.any():
        return np.empty(0), np.empty(0)
    at = frames.done[answered] - frames.due.min()
    piece = (
        np.minimum((at / at.max() * pieces).astype(np.int64), pieces - 1) if at.max() > 0 else at.astype(int)
    )
    most = np.full(pieces, -np.inf)
    np.maximum.at(most, piece, frames.resident_bytes[answered])
    seen = np.flatnonzero(np.isfinite(most))
    return (seen + 0.5) / pieces * at.max(), most[seen]
