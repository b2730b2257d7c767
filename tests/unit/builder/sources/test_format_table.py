"""Test the table of scan formats: its readers exist, and README.md and `--help` name every format."""

from pathlib import Path

import pytest
from solidcloud.builder.sources import scan_files
from solidcloud.builder.sources.format_table import FORMATS, UNSUPPORTED, ScanFormat
from solidcloud.server.cli.main import run

README = Path(__file__).parents[4] / "README.md"


@pytest.mark.parametrize("row", FORMATS, ids=lambda row: row.suffix)
def test_the_functions_of_a_row_exist(row: ScanFormat) -> None:
    assert all(callable(scan_files._reader(name)) for name in (row.reader, row.bounds) if name)


def test_suffixes_are_distinct_and_in_lower_case() -> None:
    suffixes = [row.suffix for row in FORMATS] + sorted(UNSUPPORTED)
    assert len(set(suffixes)) == len(suffixes)
    assert all(suffix.startswith(".") and suffix == suffix.lower() for suffix in suffixes)


def test_readme_and_help_name_every_format(capsys: pytest.CaptureFixture[str]) -> None:
    readme = README.read_text(encoding="utf-8").replace(",", " ").split()
    assert run(["build", "--help"]) == 0
    shown = capsys.readouterr().out.replace(".", " ").split()
    for row in FORMATS:
        assert row.name in readme
        assert row.name in shown or not row.in_folders
