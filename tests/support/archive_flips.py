"""Archives with flipped bits, as a failing disk or memory causes them; checksums are not recomputed.

A flipped archive must be refused, or give the answers of the original archive or `unknown`.
"""

import shutil
from pathlib import Path
from typing import NamedTuple

import numpy as np
from archive_mutations import AVATAR, AVATAR_RADIUS, Outcome, Template
from numpy.typing import NDArray
from solidcloud.schemas.errors import FormatError
from solidcloud.schemas.wire.answers import DistanceAnswers, Verdict
from solidcloud.server.scene import Scene

REACH = 0.1
# Most flips are single. The flips of a burst, at most this many, lie within 64 bytes.
MOST_FLIPS = 8


class Truth(NamedTuple):
    """The answers of the original archive."""

    verdict: NDArray[np.uint8]
    distance: DistanceAnswers


def true_answers(template: Template) -> Truth:
    """Query the original archive."""
    with Scene.open(template.folder, budget_bytes=32 << 20) as scene:
        scene.add_avatar("a", AVATAR, AVATAR_RADIUS)
        return Truth(scene.collide("a", template.poses).verdict, scene.distance("a", template.poses, REACH))


def flip(template: Template, seed: int, number: int, folder: Path) -> str:
    """Write case `number` into `folder`; return the name of the flipped file."""
    rng = np.random.default_rng([seed, number, 1])
    shutil.copytree(template.folder, folder)
    files = [folder / "index.h5", *sorted((folder / "shards").iterdir())]
    path = files[int(rng.integers(len(files)))]
    data = bytearray(path.read_bytes())
    at = int(rng.integers(len(data)))
    for _ in range(1 if rng.random() < 0.7 else int(rng.integers(2, MOST_FLIPS + 1))):
        data[min(at, len(data) - 1)] ^= 1 << int(rng.integers(8))
        at += int(rng.integers(64))
    path.write_bytes(data)
    return "index" if path.name == "index.h5" else "shard"


def judge_flip(truth: Truth, template: Template, folder: Path, name: str) -> Outcome:
    """Open and query a flipped archive. Raises an error if it fails in a way that it must not."""
    try:
        scene = Scene.open(folder, budget_bytes=32 << 20)
    except FormatError as refused:
        return Outcome(name, "refused", str(refused))
    with scene:
        scene.add_avatar("a", AVATAR, AVATAR_RADIUS)
        verdict = scene.collide("a", template.poses).verdict
        distance = scene.distance("a", template.poses, REACH)
    known = verdict != Verdict.UNKNOWN
    unknown = int((~known).sum())
    wrong = int((known & (verdict != truth.verdict)).sum())
    exact = distance.exact
    for column in ("signed_distance", "witness_avatar", "witness_cloud", "normal"):
        one, other = (getattr(each, column)[exact] for each in (distance, truth.distance))
        wrong += int(((one != other) & ~(np.isnan(one) & np.isnan(other))).sum())
    lower, upper = distance.lower, distance.upper
    found = truth.distance.signed_distance
    wrong += int((np.isfinite(found) & ((found < lower) | (found > upper))).sum())
    return Outcome(name, "wrong answers" if wrong else "right", f"{wrong} figures" if wrong else "", unknown)
