"""What an index says of its sources, and that it says nothing of what is usual."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from solidcloud.schemas.archive import Archive
from solidcloud.schemas.index import Header, Source, index_columns, read_header

GOLDEN = Path(__file__).resolve().parents[2] / "golden"


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
