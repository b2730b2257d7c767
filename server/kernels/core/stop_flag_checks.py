"""Stop flag of a request, as kernels read it (server/runtime/stop_flag.py).

Another thread sets the flag while a kernel runs. The compiler may move an ordinary load out of a
loop, but not an atomic one. An atomic load costs the same as an ordinary load.
"""

from ....schemas.kernels import compiling as nb
from .kernel_decorators import njit_inlined

# Largest number of node visits, for a search without a budget.
NO_LIMIT = 1 << 62
# Limit of node visits for a pose or a motion that is answered while the residency is locked: a few
# milliseconds at most. A query that needs more is answered by the general path.
MAX_RESIDENT_PATH_VISITS = 1 << 16
# Rows copied, sorted or cleared between two checks of the stop flag: some hundred microseconds.
ROWS_AT_ONCE = 512


@nb.intrinsic
def _load(context, flag):  # type: ignore[no-untyped-def]
    """Load the first element of an array (1,) int64 atomically."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        return builder.load_atomic(array.data, "monotonic", 8)

    return nb.types.int64(flag), generate


@njit_inlined
def _stopped(flag):
    return _load(flag) != 0  # type: ignore[call-arg]  # an intrinsic's first parameter is the compiler's


def _stopped_interpreted(flag):  # type: ignore[no-untyped-def]
    return flag[0] != 0


# stopped(flag): return whether the flag (1,) int64 is set. Intrinsics cannot be interpreted.
stopped = _stopped_interpreted if nb.config.DISABLE_JIT else _stopped


@njit_inlined
def should_end(flag, visits, most):
    """Return whether a search ends early.

    It does once its request is stopped or it has cost more than `most` node visits.
    """
    return stopped(flag) or visits > most


@nb.njit(nogil=True, cache=True)
def copy_rows(rows, to, count, flag):
    """Copy the first `count` rows of a table; end early once the stop flag is set."""
    for begin in range(0, count, ROWS_AT_ONCE):
        if stopped(flag):
            return
        end = min(begin + ROWS_AT_ONCE, count)
        to[begin:end] = rows[begin:end]
