"""The stop flag of a request, as kernels read it (server/stop.py).

Another thread sets the flag while a kernel runs. An ordinary load may be moved out of a loop by the compiler; an atomic
one may not. It costs what an ordinary load costs.
"""

from ...schemas.kernels import compiling as nb
from .compiled import inlined

# The most node visits of a search that has no budget.
NO_LIMIT = 1 << 62
# Node visits of a pose, or a motion, that is answered while nobody else can use the residency: a few milliseconds at
# most. What takes more is answered the ordinary way.
MOST_QUICK_VISITS = 1 << 16
# Rows copied, sorted or forgotten between two looks at the stop flag: some hundred microseconds.
ROWS_AT_ONCE = 512


@nb.intrinsic
def _load(context, flag):  # type: ignore[no-untyped-def]
    """Load the first element of an array (1,) int64 atomically."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        return builder.load_atomic(array.data, "monotonic", 8)

    return nb.types.int64(flag), generate


@inlined
def _stopped(flag):
    return _load(flag) != 0  # type: ignore[call-arg]  # an intrinsic's first parameter is the compiler's


def _stopped_interpreted(flag):  # type: ignore[no-untyped-def]
    return flag[0] != 0


# stopped(flag): return whether the flag (1,) int64 is set. Intrinsics cannot be interpreted.
stopped = _stopped_interpreted if nb.config.DISABLE_JIT else _stopped


@inlined
def is_over(flag, visits, most):
    """Return whether a search ends early: its request is stopped, or it has cost more than `most` node visits."""
    return stopped(flag) or visits > most


@nb.njit(nogil=True, cache=True)
def copy_rows(rows, to, count, flag):
    """Copy the first `count` rows of a table; not all once the stop flag is set."""
    for begin in range(0, count, ROWS_AT_ONCE):
        if stopped(flag):
            return
        end = min(begin + ROWS_AT_ONCE, count)
        to[begin:end] = rows[begin:end]
