"""How kernels are compiled.

A kernel that is handed tuples of arrays counts references: an atomic increment and decrement for each array it takes
out of a tuple or hands on, in the middle of its loops, though whoever called it holds the arrays all the while. In the
descents that was a fifth to a half of the time (scripts/bench_engine: collide 5.0 us a pose with, 4.1 without).
`borrowing` leaves the counting out. It is for functions that make no array: slices are as good as elements, but
np.empty and its like, and assignments of whole arrays, are refused by the compiler.
"""

from typing import Any

from ...schemas.kernels import compiling as nb

# By name, because numba's own types leave the option out: its underscore says that it may change. Without it kernels
# are slower and as right.
_NO_COUNTING: dict[str, Any] = {"_nrt": False}

borrowing = nb.njit(nogil=True, cache=True, **_NO_COUNTING)

# For functions of arrays that are called from one or two places, ten times a pose and more: a call hands over six words
# for each array, on the stack. distance took 8.0 us a pose in the place of 8.8 with keep_near and three more inlined,
# collide 3.5 in the place of 4.0 with sift, take_kept and lanes_meet.
inlined = nb.njit(nogil=True, cache=True, forceinline=True, **_NO_COUNTING)
