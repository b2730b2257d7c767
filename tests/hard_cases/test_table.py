"""The table of hard cases names the tests there are, and they cover every row of NUMERICS.md."""

import json
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from project_scripts import load_script

ROOT = Path(__file__).resolve().parents[2]
ROWS = 40


@pytest.fixture(scope="module")
def script() -> ModuleType:
    """scripts/make_hard_cases as a module."""
    return load_script("make_hard_cases")


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Every test marked `case`, by what pytest collects."""
    report = tmp_path_factory.mktemp("cases") / "cases.json"
    command = [
        sys.executable,
        "-P",
        "-m",
        "pytest",
        "-q",
        "--collect-only",
        "-m",
        "case",
        "--cases",
        str(report),
        # Importing all other tests takes half a minute.
        *(
            path
            for path in map(str, sorted(ROOT.glob("tests/**/test_*.py")))
            if "mark.case" in Path(path).read_text()
        ),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=250)
    assert done.returncode == 0, done.stdout
    cases: dict[str, dict[str, Any]] = json.loads(report.read_text())
    return cases


def rows_of(text: str) -> list[tuple[int, str, str]]:
    """Number, text and test of each row of the table."""
    found = re.findall(r"^\| (\d+) \| (.*?) \| .* \| \[`(\w+)`\]\(\.\./(\S+)\) \|$", text, re.MULTILINE)
    return [(int(number), said, f"{path}::{function}") for number, said, function, path in found]


def test_every_row_has_a_test_that_names_it(found: dict[str, dict[str, Any]]) -> None:
    assert {case["number"] for case in found.values()} == set(range(1, ROWS + 1))
    contract = (ROOT / "schemas" / "NUMERICS.md").read_text()
    assert [int(row) for row in re.findall(r"^\| (\d+) \|", contract, re.MULTILINE)] == list(
        range(1, ROWS + 1)
    )
    own = {test: case["number"] for test, case in found.items() if test.startswith("tests/hard_cases/")}
    assert set(own.values()) == set(range(1, ROWS + 1))
    for test, number in own.items():
        assert test.partition("::")[2].startswith(f"test_case_{number:02d}_"), test


def test_each_says_what_it_asserts_and_where_it_does_not_run(found: dict[str, dict[str, Any]]) -> None:
    for test, case in found.items():
        assert len(case["text"]) > 20 and "|" not in case["text"], test
        assert ("interpreted" in case["marks"]) != bool(case["compiled_only"]), test


def test_the_table_is_current(script: ModuleType, found: dict[str, dict[str, Any]]) -> None:
    """Results are those of the last run of scripts/make_hard_cases; numbers, texts and tests are those there are."""
    written = script.TABLE.read_text()
    assert rows_of(written) == script.case_rows(found), "run scripts/make_hard_cases"
    assert "FAILED" not in written


def test_a_row_says_what_became_of_a_case(script: ModuleType) -> None:
    case = {"number": 3, "text": "t", "marks": [], "compiled_only": "", "outcomes": ["passed"], "skipped": ""}
    changes = {
        "passed": {},
        "FAILED": {"outcomes": ["passed", "failed"]},
        "not run: no scans": {"outcomes": ["skipped"], "skipped": "no scans"},
        "not run: too slow": {"outcomes": [], "compiled_only": "too slow"},
        "not run: takes minutes": {"outcomes": [], "marks": ["slow"]},
    }
    for said, change in changes.items():
        assert script.result("interpreted", case | change) == said
    runs = {mode: {"tests/hard_cases/a.py::test_case_03_x": case} for mode in script.MODES}
    assert rows_of(script.table(runs)) == [(3, "t", "tests/hard_cases/a.py::test_case_03_x")]
