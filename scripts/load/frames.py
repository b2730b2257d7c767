"""What became of every frame of a run, and the figures made of it."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.answers import Verdict

from .pace import after_first, stalled

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# A frame is answered, or refused with an error, or nothing came.
NOTHING, ANSWERED, REFUSED = 0, 1, 2
PERCENTILES = (50.0, 99.0, 99.9, 100.0)


class Frames(NamedTuple):
    """n frames in order of when they were due; times are seconds on one clock.

    user: (n,) int64.  due, sent, done: when it should be asked, was asked, and its answer was decoded; NaN: never.
    status: (n,) of the three above.  verdict: (n,) int64, -1 without an answer.  hits, misses: of the answer, voxels.
    engine, wait: time in the server's engine, and what of it was waiting for voxels, whoever had them loaded [s].
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
    """A run in figures; times [s], of frames after the first second of each user, all but the counts of faults.

    without_miss, waited: shares of the answered frames.  hit_rate: of voxels.
    delays, waits: percentiles (PERCENTILES) of due to done, and of the wait for voxels.  round_trips: of sent to done.
    late: 99th percentile of due to sent: what the users themselves were behind.  rate: answers a second.
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
    """Frames (n,) of which nothing came yet."""
    n = len(user)
    return Frames(
        user, due, np.full(n, np.nan), np.full(n, np.nan), np.full(n, NOTHING), np.full(n, -1),
        np.zeros(n, np.int64), np.zeros(n, np.int64), np.full(n, np.nan), np.full(n, np.nan), np.zeros(n, np.int64),
    )  # fmt: skip


def merged(parts: list[Frames]) -> Frames:
    """Frames of several processes as those of one, in order of when they were due; at equal times of users."""
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.lexsort((columns[0], columns[1]))
    return Frames(*(column[order] for column in columns))


def save(path: Path, frames: Frames, **more: NDArray) -> None:
    """Write frames, and whatever else, as .npz."""
    np.savez(path, **frames._asdict(), **more)


def load(path: Path) -> tuple[Frames, dict[str, NDArray]]:
    """Read what `save` wrote: the frames, and what else there is."""
    with np.load(path, allow_pickle=False) as file:
        columns = {name: file[name] for name in file.files}
    return Frames(*(columns.pop(name) for name in Frames._fields)), columns


def percentiles(values: Floats, shares: tuple[float, ...] = PERCENTILES) -> Floats:
    """Percentiles of what is a number; NaN of nothing. No value between two that were measured is made up."""
    known = values[np.isfinite(values)]
    if not len(known):
        return np.full(len(shares), np.nan)
    return np.percentile(known, shares, method="higher")


def figures(frames: Frames, warm_up: float = 1.0) -> Figures:
    """The figures of a run. warm_up: seconds of each user that count only for refused, unanswered and unknown."""
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
    """Most resident bytes that any answer told of, in so many pieces of the run: times from its start [s], bytes."""
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
