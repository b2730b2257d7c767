"""The helpers of scripts/mutation: what is drawn, what is left out, what is kept, how a trial ends."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("cosmic_ray", reason="scripts/mutation_cases/requirements.txt is not installed")

from mutation_cases import document, results, trial
from mutation_cases.mutants import Mutant, draw
from mutation_cases.plan import NONE, TESTS

SOURCE = '''"""Doubled - or not."""
import numba as nb
from typing import NamedTuple

class Pair(NamedTuple):
    """Two - of them."""
    first: int | None = 3

@nb.njit(nogil=True, cache=True)
def twice(a: int | float, b):
    """a * 2 + b."""
    return a * 2 if a < b and b else b
'''


def drawn(seed: int = 1) -> list[Mutant]:
    """All mutants of SOURCE."""
    return [mutant for mutant, _ in draw(Path("a.py"), SOURCE, seed)]


def test_a_draw_is_the_same_for_the_same_seed() -> None:
    assert drawn() == drawn()
    assert drawn() != drawn(2) and sorted(drawn()) == sorted(drawn(2))


def test_only_what_a_kernel_computes_with_is_changed() -> None:
    mutants = drawn()
    assert {mutant.line for mutant in mutants} == {12} and {mutant.function for mutant in mutants} == {
        "twice"
    }
    assert all(mutant.was == "return a * 2 if a < b and b else b" for mutant in mutants)
    now = {mutant.now for mutant in mutants}
    assert {
        "return a + 2 if a < b and b else b",
        "return a * 2 if a <= b and b else b",
        "return a * 2 if a < b or b else b",
        "return a * 2 if not a < b and b else b",
    } <= {" ".join(text.split()) for text in now}
    assert not any(" is " in text for text in now)
    assert len(now) == len(mutants), "each change once"


def test_every_place_comes_once_before_any_comes_twice() -> None:
    kinds = [mutant.operator.split("_")[0] for mutant in drawn()]
    places = [
        "AddNot",
        "NumberReplacer",
        "ReplaceAndWithOr",
        "ReplaceBinaryOperator",
        "ReplaceComparisonOperator",
    ]
    assert sorted(kinds[: len(places)]) == places


def outcome(kind: str) -> trial.Outcome:
    """An outcome."""
    return trial.Outcome(kind, "test", "what", 1.0)


def test_what_the_compiler_would_refuse_counts_for_nothing() -> None:
    own = results.FileResults("source", "tests", 1)
    kinds = [trial.FAILED, trial.ERROR, trial.TIME, trial.PASSED, trial.REFUSED]
    for mutant, kind in zip(drawn(), kinds, strict=False):
        own.add(mutant, outcome(kind))
    assert (own.counted(), own.killed(), document.share(own)) == (4, 3, 0.75)
    assert not own.wants(drawn()[0], 9, 0) and own.wants(drawn()[9], 9, 0)
    assert not own.wants(drawn()[9], 9, 5) and not own.wants(drawn()[9], 4, 0)


def test_results_hold_for_one_source_and_survivors_for_one_set_of_tests() -> None:
    kept = results.Results({})
    own = kept.take("a.py", SOURCE, "tests", 1)
    own.add(drawn()[0], outcome(trial.FAILED))
    own.add(drawn()[1], outcome(trial.PASSED))
    assert kept.take("a.py", SOURCE, "tests", 1).counted() == 2
    own = kept.take("a.py", SOURCE, "other tests", 1)
    assert own.counted() == 1 and own.again == [drawn()[1].key]
    assert own.wants(drawn()[1], 1, 0) and not own.wants(drawn()[2], 2, 0), "the sample stays what it was"
    own.add(drawn()[1], outcome(trial.PASSED))
    assert own.counted() == 2 and not own.again
    assert kept.take("a.py", SOURCE, "other tests", 2).counted() == 0
    assert kept.take("a.py", SOURCE + "\n", "other tests", 2).counted() == 0


def test_a_long_change_is_shown_where_it_is() -> None:
    was = "x" * 90 + " a + b " + "y" * 90
    assert document.differing(was, was.replace("+", "-")) == tuple(
        f"… {'x' * 27} a {sign} b {'y' * 27} …" for sign in "+-"
    )


def test_every_kernel_file_is_planned_and_every_test_planned_is_there() -> None:
    kernels = {
        path.relative_to(trial.ROOT).as_posix()
        for package in trial.PACKAGES
        for path in (trial.ROOT / package / "kernels").rglob("*.py")
        if path.name != "__init__.py"
    }
    assert set(TESTS) | set(NONE) == kernels
    for test in {test for tests in TESTS.values() for test in tests}:
        path, _, name = test.partition("::")
        text = (trial.ROOT / path).read_text()
        assert not name or f"def {name.split('[')[0]}(" in text, test


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (("value & ", "value & "), trial.PASSED),
        (("value & np.uint64(0x1FFFFF)", "value & np.uint64(0)"), trial.FAILED),
        (("for i in range(n):\n        codes", "for i in range(n + 1):\n        codes"), trial.ERROR),
        (("for i in range(n):\n        codes", "for i in range(n / 2):\n        codes"), trial.REFUSED),
        (("n = coordinates.shape[0]", "n = coordinates.shape[0]\n    while True:\n        pass"), trial.TIME),
    ],
)
def test_a_trial_ends_as_its_tests_do(tmp_path: Path, change: tuple[str, str], kind: str) -> None:
    """In a process of its own, which has not imported what is changed, as scripts/mutation has not."""
    program = f"""
import os, sys
os.environ["NUMBA_DISABLE_JIT"] = "1"
sys.path.insert(0, {str(trial.ROOT / "scripts")!r})
from pathlib import Path
from mutation_cases import trial
folder, file = Path({str(tmp_path)!r}), "schemas/kernels/morton.py"
trial.copy_sources(folder)
source = (folder / "solidcloud" / file).read_text()
assert {change[0]!r} in source
own = trial.begin(folder, file, source.replace(*{change!r}, 1), ["tests/unit/schemas/kernels/test_morton.py"], 4)
while not (outcome := own.outcome(1.0)):
    pass
print(outcome.kind)
"""
    said = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert said.stdout.split()[-1] == kind
