"""Compilation options of the kernels.

A kernel that receives tuples of arrays counts references: numba increments and decrements an atomic
counter for each array that is taken out of a tuple or passed on, inside the kernel's loops,
although the caller holds the arrays for the whole call. In the descents this took between a fifth
and a half of the time (scripts/bench_engine: collide 5.0 us a pose with counting, 4.1 without).

`njit_no_refcount` disables the counting. It is for functions that create no array. Such a function
may use elements and slices; the compiler refuses np.empty and similar calls, and assignments of
whole arrays.
"""

from typing import Any

from ....schemas.runtime import compiling as nb

# Given by name, because numba's own types omit this option: its underscore marks it as subject to
# change. Without it, kernels are slower and equally correct.
_NO_COUNTING: dict[str, Any] = {"_nrt": False}

njit_no_refcount = nb.njit(nogil=True, cache=True, **_NO_COUNTING)

# For functions that take arrays, have one or two callers and run ten or more times a pose: a call
# passes six words for each array on the stack. With mark_near and three more inlined, distance took
# 8.0 us a pose instead of 8.8; with mark_meeting, compact_marked and lanes_meet inlined, collide
# took 3.5 instead of 4.0.
njit_inlined = nb.njit(nogil=True, cache=True, forceinline=True, **_NO_COUNTING)
