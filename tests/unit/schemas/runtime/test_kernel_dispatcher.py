"""Test the two ways to call a kernel: from Python, and from another kernel."""

import os

import numba
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


@njit()
def middle(values):  # type: ignore[no-untyped-def]
    """Return the median."""
    return np.median(values)


def test_functions_that_numba_compiles_share_its_library_with_kernels() -> None:
    """The library's functions have no machine code of their own, whichever calls them first."""
    values = np.array([3.0, 1.0, 2.0])
    plain = numba.njit(lambda array: (np.median(array), np.sort(array)[0]))
    assert middle(values) == 2.0
    assert plain(values) == (2.0, 1.0)
