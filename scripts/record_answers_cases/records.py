"""Digests of answers, and their files.

A file of answers is NAME.json, with archives, groups and the digests of each field of a group, and
NAME.npz, with a digest, a verdict and one number of each request, in the order of the groups.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from hashlib import blake2b
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# The number of a request that is stored beside its digest: the first of these that it has.
NUMBERS = ("signed_distance", "upper", "distance", "cluster_deepest", "left", "pair_verdict")


class Answered(NamedTuple):
    """Answers of a group.

    digests: (n,) uint64.  verdicts: (n,) uint8.  numbers: (n,) float64.
    fields: digest of each field over all requests.  items: of requests that differ, at most three.
    """

    digests: NDArray[np.uint64]
    verdicts: NDArray[np.uint8]
    numbers: NDArray[np.float64]
    fields: dict[str, str]
    items: dict[int, dict[str, Any]]


class Recorded(NamedTuple):
    """Recorded answers. archives: digest of the content by name.  groups: answers by name."""

    archives: dict[str, str]
    groups: dict[str, Answered]


def canonical(value: Any) -> bytes:
    """Return the bytes of a value: numbers bit for bit, as float64 or int64, every NaN alike."""
    if isinstance(value, Mapping):
        return canonical([part for name in sorted(value) for part in (name, value[name])])
    if isinstance(value, str):
        return b"s" + value.encode() + b"\0"
    if value is None:
        return b"-"
    if isinstance(value, list | tuple):
        return b"[" + b"".join(map(canonical, value)) + b"]"
    array = np.asarray(value)
    if array.dtype.kind == "f":
        array = np.where(np.isnan(array), np.nan, array).astype("<f8")
    elif array.dtype.kind in "biu":
        array = array.astype("<i8")
    else:
        raise TypeError(f"a field of type {type(value).__name__}: expected numbers, strings or lists of them")
    return f"{array.dtype.kind}{array.shape}".encode() + array.tobytes()


def answered(items: Iterable[dict[str, Any]], expected: Sequence[int] = ()) -> Answered:
    """Return the digests of answers. expected: their digests; the first requests that differ are kept."""
    digests, verdicts, numbers = [], [], []
    kept: dict[int, dict[str, Any]] = {}
    fields: dict[str, Any] = {}
    for number, item in enumerate(items):
        whole = blake2b(digest_size=8)
        for name, value in item.items():
            data = canonical(value)
            whole.update(name.encode() + data)
            fields.setdefault(name, blake2b(digest_size=8)).update(data)
        digests.append(int.from_bytes(whole.digest(), "little"))
        verdicts.append(int(np.max(item["verdict"], initial=0)))
        values: Any = next((np.ravel(item[name]) for name in NUMBERS if name in item), [])
        numbers.append(float(values[0]) if len(values) else 0.0)
        if number < len(expected) and expected[number] != digests[-1] and len(kept) < 3:
            kept[number] = item
    found = np.array(digests, np.uint64), np.array(verdicts, np.uint8), np.array(numbers)
    return Answered(*found, {name: each.hexdigest() for name, each in fields.items()}, kept)


def content_digest(*arrays: Any) -> str:
    """Return the digest of an archive's content."""
    return blake2b(canonical(list(arrays)), digest_size=8).hexdigest()


def write(path: Path, recorded: Recorded) -> None:
    """Write recorded answers. path: without suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    groups = {name: {"requests": len(g.digests), "fields": g.fields} for name, g in recorded.groups.items()}
    about = {"archives": recorded.archives, "groups": groups}
    path.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n")
    columns: dict[str, Any] = {
        name: np.concatenate([getattr(group, name) for group in recorded.groups.values()])
        for name in ("digests", "verdicts", "numbers")
    }
    np.savez_compressed(path.with_suffix(".npz"), **columns)


def read(path: Path) -> Recorded:
    """Return recorded answers. path: without suffix."""
    about = json.loads(path.with_suffix(".json").read_text())
    groups, first = {}, 0
    with np.load(path.with_suffix(".npz")) as columns:
        digests, verdicts, numbers = (columns[name] for name in ("digests", "verdicts", "numbers"))
    for name, group in about["groups"].items():
        rows = slice(first, first + group["requests"])
        groups[name] = Answered(digests[rows], verdicts[rows], numbers[rows], group["fields"], {})
        first += group["requests"]
    return Recorded(about["archives"], groups)
