"""Test the parts of scripts/mutation that need cosmic-ray: the mutants drawn, and the end of a trial."""

import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip("cosmic_ray", reason="scripts/mutation_cases/requirements.txt is not installed")

from mutation_cases import trial
from mutation_cases.mutants import Mutant, draw

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
    """Return all mutants of SOURCE."""
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
    """Test in a separate process that has not imported the changed module, as in scripts/mutation."""
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
