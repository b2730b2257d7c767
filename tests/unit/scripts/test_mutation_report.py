"""Test the results, reasons and plan of scripts/mutation."""

import re
from pathlib import Path
from typing import NamedTuple

import pytest
from mutation_cases import mutation_report, trial, trial_results
from mutation_cases.plan import LOWER_GOALS, NONE, TESTS

SOURCE = "return a * 2"


class Mutant(NamedTuple):
    """A mutant as mutation_cases.mutants.Mutant, which requires cosmic-ray."""

    key: str
    line: int = 3
    function: str = "twice"
    was: str = "return a * 2"
    now: str = "return a + 2"


MUTANTS = [Mutant(f"operator:{i}") for i in range(12)]


def outcome(kind: str) -> trial.Outcome:
    """Return an outcome."""
    return trial.Outcome(kind, "test", "what", 1.0)


def test_what_the_compiler_would_refuse_counts_for_nothing() -> None:
    own = trial_results.FileResults("source", "tests", 1)
    kinds = [trial.FAILED, trial.ERROR, trial.TIME, trial.PASSED, trial.REFUSED]
    for mutant, kind in zip(MUTANTS, kinds, strict=False):
        own.add(mutant, outcome(kind))
    assert (own.counted(), own.killed(), mutation_report.share(own)) == (4, 3, 0.75)
    assert not own.wants(MUTANTS[0], 9, 0) and own.wants(MUTANTS[9], 9, 0)
    assert not own.wants(MUTANTS[9], 9, 5) and not own.wants(MUTANTS[9], 4, 0)


def test_results_hold_for_one_source_and_survivors_for_one_set_of_tests(
    tmp_path: Path,
) -> None:
    kept = trial_results.Results(tmp_path / "results.json", {})
    own = kept.take("a.py", SOURCE, "tests", 1)
    own.add(MUTANTS[0], outcome(trial.FAILED))
    own.add(MUTANTS[1], outcome(trial.PASSED))
    assert kept.take("a.py", SOURCE, "tests", 1).counted() == 2
    own = kept.take("a.py", SOURCE, "other tests", 1)
    assert own.counted() == 1 and own.again == [MUTANTS[1].key]
    assert own.wants(MUTANTS[1], 1, 0) and not own.wants(MUTANTS[2], 2, 0), "the sample stays what it was"
    own.add(MUTANTS[1], outcome(trial.PASSED))
    assert own.counted() == 2 and not own.again
    assert kept.take("a.py", SOURCE, "other tests", 2).counted() == 0
    assert kept.take("a.py", SOURCE + "\n", "other tests", 2).counted() == 0


@pytest.mark.parametrize(
    ("was", "now", "change"),
    [
        ("while lo < hi:", "while lo <= hi:", "while lo<hi → <="),
        ("n = codes.shape[0]", "n = codes.shape[ -1]", "shape[0] → -1"),
        ("if a and b:", "if a or b:", "if a and b → or"),
        ("if a:", "if not a:", "if a → not"),
        ("break", "continue", "break → continue"),
    ],
)
def test_a_change_is_its_tokens_and_their_neighbours(was: str, now: str, change: str) -> None:
    assert mutation_report.describe_change(was, now) == change


def test_a_reason_holds_for_a_change_in_a_function() -> None:
    known = mutation_report.reasons(
        "**Not a reason.** Text with `code` alone.\n\n**A bound that is\nrounded.**\n\n"
        "- `a.py`: `twice` `return a*2 → +`, `x → y`; `module`\n  `N=1 → 2`\n- `*`: `*` `any → all`\n\n**Other.**\n\n"
        "- `b.py`: `*` `(1) → 2`\n"
    )
    assert known == {
        ("a.py", "twice", "return a*2 → +"): "A bound that is rounded.",
        ("a.py", "twice", "x → y"): "A bound that is rounded.",
        ("a.py", "module", "N=1 → 2"): "A bound that is rounded.",
        ("*", "*", "any → all"): "A bound that is rounded.",
        ("b.py", "*", "(1) → 2"): "Other.",
    }

    def found(file: str, function: str, was: str, now: str) -> str:
        return mutation_report.reason_of(file, {"function": function, "was": was, "now": now}, known)

    assert found("server/a.py", "twice", "b * 2", "b + 2") == ""
    assert found("server/a.py", "twice", "return a * 2", "return a + 2") == "A bound that is rounded."
    assert found("server/a.py", "", "N = 1", "N = 2") == "A bound that is rounded."
    assert found("server/b.py", "f", "g(1)", "g(2)") == ""
    assert found("server/b.py", "f", "(1)", "(2)") == "Other."


def test_a_survivor_without_a_reason_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    kept = trial_results.Results(tmp_path / "results.json", {})
    own = kept.take("server/a.py", SOURCE, "tests", 1)
    for mutant in MUTANTS[1:]:
        own.add(mutant, outcome(trial.FAILED))
    own.add(MUTANTS[0], outcome(trial.PASSED))
    kept.save()
    kept = trial_results.load(kept.place)
    change = mutation_report.describe_change(MUTANTS[0].was, MUTANTS[0].now)
    known = {("a.py", "twice", change): "It is so."}
    assert mutation_report.verdict(kept, known, ["server/a.py"]) and not capsys.readouterr().err
    text = mutation_report.report(kept, known)
    assert "| `server/a.py` | 12 | 11 | 0 | 0 | 1 | 92% | 0 |" in text and "**It is so.**" in text
    assert not mutation_report.verdict(kept, {}, ["server/a.py"])
    assert "survivor without a reason in MUTATION.md: server/a.py:3" in capsys.readouterr().err
    assert (
        not mutation_report.verdict(kept, known, ["server/b.py"]) and "not tried" in capsys.readouterr().err
    )


def test_every_reason_is_for_a_function_there_is() -> None:
    known = mutation_report.reasons(mutation_report.REASONS.read_text())
    sources = {Path(name).name: (trial.ROOT / name).read_text() for name in TESTS}
    assert len(sources) == len(TESTS), "files are told apart by their names"
    assert len(known) > 100
    for file, function, _ in known:
        assert file == mutation_report.ANY or file in sources, file
        if function not in (mutation_report.ANY, mutation_report.MODULE):
            assert re.search(rf"^def {function}\(", sources[file], re.MULTILINE), (file, function)


def test_every_kernel_file_is_planned_and_every_test_planned_is_there() -> None:
    kernels = {
        path.relative_to(trial.ROOT).as_posix()
        for package in trial.PACKAGES
        for path in (trial.ROOT / package / "kernels").rglob("*.py")
        if path.name != "__init__.py"
    }
    assert set(TESTS) | set(NONE) == kernels and set(LOWER_GOALS) <= set(TESTS)
    for test in {test for tests in TESTS.values() for test in tests}:
        path, _, name = test.partition("::")
        text = (trial.ROOT / path).read_text()
        assert not name or f"def {name.split('[')[0]}(" in text, test
