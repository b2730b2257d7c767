"""Array types of message fields. A type states the dtype and all axis lengths but the first."""

import math
from functools import cache
from typing import Any, Literal, NamedTuple, get_args, get_origin, get_type_hints

import numpy as np

# The shape is part of the type: `int` is any length, a Literal is exactly that length.
Poses = np.ndarray[tuple[int, Literal[4], Literal[4]], np.dtype[np.float64]]
Positions = np.ndarray[tuple[int, Literal[3]], np.dtype[np.float64]]
IndexPairs = np.ndarray[tuple[int, Literal[2]], np.dtype[np.int32]]


class ArrayType(NamedTuple):
    """Dtype (little-endian), fixed axis lengths and bytes per row of an array field."""

    dtype: np.dtype
    tail: tuple[int, ...]
    row_bytes: int


def without_alias(hint: Any) -> Any:
    """Return the type that an annotation stands for if it is a type alias, else the annotation.

    `NDArray` is an alias of `np.ndarray` from numpy 2.5 on.
    """
    alias = get_origin(hint) or hint
    if not hasattr(alias, "__value__"):
        return hint
    value, given = alias.__value__, dict(zip(alias.__type_params__, get_args(hint), strict=False))
    return without_alias(value[tuple(given[of] for of in value.__parameters__)] if given else value)


@cache
def array_type(hint: Any) -> ArrayType:
    """Parse the dtype and the fixed axis lengths from an array's type annotation."""
    shape, of = get_args(without_alias(hint))
    tail = tuple(get_args(axis)[0] for axis in get_args(shape)[1:] if get_origin(axis) is Literal)
    dtype = np.dtype(get_args(of)[0]).newbyteorder("<")
    return ArrayType(dtype, tail, dtype.itemsize * math.prod(tail))


@cache
def array_fields(kind: type) -> dict[str, ArrayType]:
    """Return the array fields of a message type by name, in declaration order."""
    return {
        name: array_type(hint)
        for name, hint in get_type_hints(kind).items()
        if get_origin(without_alias(hint)) is np.ndarray
    }
