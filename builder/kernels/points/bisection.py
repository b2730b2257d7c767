"""Bisection of a range of sorted values inside kernels: np.searchsorted without creating a slice."""

from ....schemas.kernels import compiling as nb


@nb.njit(nogil=True, cache=True)
def first_at_least(values, lo, hi, value):
    """Return the first index in [lo, hi) of values (n,) that is not below value; hi when there is none.

    values must be sorted in [lo, hi). value must have the type of values: numba compares an
    unsigned with a signed integer as float64.
    """
    while lo < hi:
        mid = (lo + hi) // 2
        if values[mid] < value:
            lo = mid + 1
        else:
            hi = mid
    return lo
