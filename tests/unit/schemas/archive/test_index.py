"""Test the sources of an index, and that defaults are not stored."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.index import Header, Source, index_columns, read_header

GOLDEN = Path(__file__).resolve().parents[3] / "golden"


def golden_header() -> Header:
    """The header of some committed archive."""
    folder = next(path.parent for path in sorted(GOLDEN.rglob("index.h5")))
    with Archive(folder) as archive:
        return archive.header


def test_units_up_and_crs_of_a_source_are_read_back_and_the_usual_is_not_written() -> None:
    header = golden_header()
    plain = Source("a.las", 0, "las", "00", 1, np.eye(4), {})
    told = replace(plain, path="b.las", crs='PROJCS["Zürich"]', units="us-ft", up="y")
    header = replace(header, sources=(plain, told))
    columns = index_columns(header, np.zeros(0, np.uint8), [])
    read = read_header(header.archive_id, columns)
    assert [(s.crs, s.units, s.up) for s in read.sources] == [
        ("", "m", "z"),
        ('PROJCS["Zürich"]', "us-ft", "y"),
    ]
    first, second = json.loads(columns["texts"].tobytes())["sources"]
    assert set(second) - set(first) == {"crs", "units", "up"}
    assert columns["texts"].max() < 128


@pytest.mark.parametrize(
    ("told", "good"), [(0, True), (-1, True), (1, False), (-2, False), ("0", False), (True, False)]
)
def test_the_box_of_a_source_that_was_left_out_is_one_of_those_there_are(told: Any, good: bool) -> None:
    header = golden_header()
    lost = Source("a.las", 0, "", "", 0, np.eye(4), {}, "broken", unknown=told)
    header = replace(header, sources=(lost,), unknown=np.zeros((1, 2, 3), np.int64), unknown_everywhere=True)
    columns = index_columns(header, np.zeros(0, np.uint8), [])
    if not good:
        with pytest.raises(ValueError, match=r"expected distinct boxes, or -1|Expected `int"):
            read_header(header.archive_id, columns)
        return
    assert [s.unknown for s in read_header(header.archive_id, columns).sources] == [told]
