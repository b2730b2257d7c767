"""Test the two ways to call a kernel: from Python, and from another kernel."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from solidcloud.schemas.kernels.morton import morton_code, morton_encode
from solidcloud.schemas.runtime.compiling import njit, types
from solidcloud.schemas.runtime.kernel_dispatcher import in_order

pytestmark = pytest.mark.skipif(
    os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="interpreted kernels are plain functions"
)


@njit()
def half(value):  # type: ignore[no-untyped-def]
    """Return half of a value; raise ValueError below 0."""
    if value < 0:
        raise ValueError("expected a value of at least 0")
    return value / 2


@njit()
def quarter(value):  # type: ignore[no-untyped-def]
    """Return a quarter of a value."""
    return half(half(value))


def test_a_kernel_has_the_same_result_for_python_and_for_a_kernel() -> None:
    assert half(3.0) == 1.5
    assert quarter(3.0) == 0.75
    x, y, z = np.uint64(1), np.uint64(2), np.uint64(3)
    assert morton_code(x, y, z) == morton_encode(np.array([[x, y, z]]))[0] == 53


def test_a_kernel_raises_what_an_inner_kernel_raises() -> None:
    with pytest.raises(ValueError, match="at least 0"):
        quarter(-1.0)


@njit()
def eighth(value):  # type: ignore[no-untyped-def]
    """Return an eighth of a value."""
    return half(quarter(value))


def test_an_inner_kernel_holds_its_own_code_and_names_what_it_calls() -> None:
    arguments = (types.float64,)
    eighth.inner.compile(arguments)
    library = eighth.inner.overloads[arguments].library
    defined = [each.name for each in library.own_module().functions if not each.is_declaration]
    assert any("eighth" in name for name in defined)
    assert not any("half" in name or "quarter" in name for name in defined)
    assert sorted(callee.name for callee in library.callees) == ["half", "quarter"]


def test_what_calls_is_linked_before_what_it_calls() -> None:
    """Half is called by both, and must come after both."""
    eighth.inner.compile((types.float64,))
    library = eighth.inner.overloads[types.float64,].library
    for callees in (library.callees, library.callees[::-1]):
        assert [each.name for each in in_order(callees)] == ["quarter", "half"]
    assert eighth(4.0) == 0.5


OWN_CODE = """
import gc, sys
import numba, numpy as np
from numba.extending import register_jitable
gc.set_threshold(0)
from solidcloud.schemas.kernels.morton import morton_encode
assert morton_encode(np.ones((1, 3), np.uint64)) == 7
assert gc.get_threshold()[0] == 0

@numba.njit(parallel=True)
def total(a, b):
    return (a + b).sum()

@register_jitable(cache=True)
def halved(x):
    return x / 2

@numba.njit(cache=True)
def apply(f, x):
    return halved(f(x))

@numba.njit(cache=True)
def of_sine(x):
    return apply(np.sin, x)

assert total(np.ones(3), np.ones(3)) == 6.0
assert of_sine(0.0) == 0.0
"""


def test_code_that_a_user_compiles_in_the_same_process_works(tmp_path: Path) -> None:
    (tmp_path / "own_code.py").write_text(OWN_CODE)
    own = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    assert (
        subprocess.run([sys.executable, "-P", tmp_path / "own_code.py"], env=own, check=False).returncode == 0
    )
