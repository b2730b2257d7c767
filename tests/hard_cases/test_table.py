"""The table of hard cases names the tests there are, and they cover every row of NUMERICS.md."""

import ast
import re
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
def found() -> dict[str, dict[str, Any]]:
    """Every test marked `case`, in the order in which pytest collects them."""
    cases = {}
    for path in sorted(ROOT.glob("tests/**/test_*.py")):
        if "mark.case(" not in path.read_text():
            continue
        for test in ast.parse(path.read_text()).body:
            for mark in test.decorator_list if isinstance(test, ast.FunctionDef) else []:
                if isinstance(mark, ast.Call) and ast.unparse(mark.func) == "pytest.mark.case":
                    number, text = map(ast.literal_eval, mark.args)
                    cases[f"{path.relative_to(ROOT)}::{test.name}"] = {"number": number, "text": text}
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


def test_the_table_is_current(script: ModuleType, found: dict[str, dict[str, Any]]) -> None:
    """Results are those of the last run of scripts/make_hard_cases; numbers, texts and tests are those there are."""
    written = script.TABLE.read_text()
    assert rows_of(written) == script.case_rows(found), "run scripts/make_hard_cases"
    assert "FAILED" not in written


def test_a_row_says_what_became_of_a_case(script: ModuleType) -> None:
    case = {"number": 3, "text": "t", "marks": [], "outcomes": ["passed"], "skipped": ""}
    changes = {
        "passed": {},
        "FAILED": {"outcomes": ["passed", "failed"]},
        "not run: no scans": {"outcomes": ["skipped"], "skipped": "no scans"},
        "not run: takes minutes": {"outcomes": [], "marks": ["slow"]},
    }
    for said, change in changes.items():
        assert script.result(case | change) == said
    runs = {mode: {"tests/hard_cases/a.py::test_case_03_x": case} for mode in script.MODES}
    assert rows_of(script.table(runs)) == [(3, "t", "tests/hard_cases/a.py::test_case_03_x")]
