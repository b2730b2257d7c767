"""Texts of an archive's index: JSON, parsed with a type for every field.

FORMAT.md, "index.h5", documents the same; change both together.
"""

import json
from typing import Annotated, Any, Literal, NoReturn

import msgspec
from numpy.typing import NDArray

_Count = Annotated[int, msgspec.Meta(ge=0)]


class _SourceTexts(msgspec.Struct):
    """Texts of one source; see `Source` in index.py."""

    path: str
    index: _Count
    format: str
    sha256: str
    skipped: dict[str, _Count]
    fault: str
    crs: str = ""
    units: str = "m"
    up: str = "z"
    unknown: int | None = None
    one_place: bool = False


class Texts(msgspec.Struct):
    """Content of `texts`; `_texts` of index.py writes it."""

    lattice_source: Literal["sources", "given", "default"]
    radius_model: Literal["mean", "given"]
    options: dict[str, Any]
    sources: list[_SourceTexts]


def _no_number(name: str) -> NoReturn:
    """Refuse NaN and infinity, which Python's JSON parser accepts as numbers."""
    raise ValueError(f"texts with {name}: expected JSON")


def read_texts(columns: dict[str, NDArray]) -> Texts:
    """Parse `texts` and compare it with the other datasets. Raises ValueError."""
    try:
        texts = msgspec.convert(
            json.loads(columns["texts"].tobytes(), parse_constant=_no_number), Texts, strict=True
        )
    except (msgspec.ValidationError, RecursionError) as error:
        raise ValueError(f"texts: {error}") from error
    sources, boxes = len(texts.sources), len(columns["unknown"])
    if sources != len(columns["source_pose"]):
        raise ValueError(f"texts of {sources} sources: expected {len(columns['source_pose'])}")
    rows = [s.unknown for s in texts.sources if s.unknown is not None and s.unknown != -1]
    if len(set(rows)) < len(rows) or not all(0 <= row < boxes for row in rows):
        raise ValueError(f"sources with boxes {rows} of {boxes}: expected distinct boxes, or -1")
    if any(s.unknown == -1 for s in texts.sources) and not columns["unknown_everywhere"][0]:
        raise ValueError(
            "unknown_everywhere 0: expected 1, because a source with unknown bounds was left out"
        )
    return texts
