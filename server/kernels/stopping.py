"""The stop flag of a request, as kernels read it (server/stop.py).

Another thread sets the flag while a kernel runs. An ordinary load may be moved out of a loop by the compiler; an atomic
one may not. It costs what an ordinary load costs.
"""

from ...schemas.kernels import compiling as nb
from .compiled import inlined


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
