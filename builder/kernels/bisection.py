"""Bisection of sorted values, inside kernels: np.searchsorted of a part, without a slice of it."""

from ...schemas.kernels import compiling as nb


@nb.njit(nogil=True, cache=True)
def first_at_least(values, lo, hi, value):
    """First index in [lo, hi) of values (n,), sorted there, that is not below value; hi when there is none.

    value: of the values' type, as an unsigned and a signed integer would be compared as float64.
    """
    while lo < hi:
        mid = (lo + hi) // 2
        if values[mid] < value:
            lo = mid + 1
        else:
            hi = mid
    return lo
