"""Arrays in messages: their dtype and the lengths of all axes but the first are part of the field's type."""

import math
from functools import cache
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import numpy as np

# The shape is part of the type: an int is any length, a Literal is that length.
Poses = np.ndarray[tuple[int, Literal[4], Literal[4]], np.dtype[np.float64]]
Positions = np.ndarray[tuple[int, Literal[3]], np.dtype[np.float64]]
IndexPairs = np.ndarray[tuple[int, Literal[2]], np.dtype[np.int32]]


class ArrayType(NamedTuple):
    """What an array's type says: its dtype, little-endian, and the lengths of all axes but the first."""

    dtype: np.dtype
    tail: tuple[int, ...]
    row_bytes: int


@cache
def array_type(hint: Any) -> ArrayType:
    """What an array's type says."""
    shape, of = get_args(hint)
    tail = tuple(get_args(axis)[0] for axis in get_args(shape)[1:] if get_origin(axis) is Literal)
    dtype = np.dtype(get_args(of)[0]).newbyteorder("<")
    return ArrayType(dtype, tail, dtype.itemsize * math.prod(tail))


@cache
def array_fields(kind: type) -> dict[str, ArrayType]:
    """The fields of a message that are arrays, in their order."""
    return {
        name: array_type(hint)
        for name, hint in get_type_hints(kind).items()
        if get_origin(hint) is np.ndarray
    }
