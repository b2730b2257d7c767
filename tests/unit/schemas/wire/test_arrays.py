"""Test that the array fields of a message are found by their annotations."""

from typing import Literal, TypeVar

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray
from solidcloud.schemas.wire.arrays import array_fields

TypeAliasType = pytest.importorskip("typing_extensions").TypeAliasType

S = TypeVar("S", bound=np.generic)
N = TypeVar("N")
# numpy 2.5 has NDArray as such an alias; its parameters may come in another order than they are used.
Array = TypeAliasType("Array", np.ndarray[tuple[int, ...], np.dtype[S]], type_params=(S,))
Rows = TypeAliasType("Rows", np.ndarray[tuple[int, N], np.dtype[S]], type_params=(S, N))
Colours = TypeAliasType("Colours", Rows[np.uint8, Literal[3]])


class Message(msgspec.Struct):
    plain: NDArray[np.float64]
    aliased: Array[np.int32]
    swapped: Rows[np.float32, Literal[4]]
    nested: Colours
    number: int
    listed: list[int]


def test_fields_are_found_through_type_aliases_of_issue_35():
    found = {name: (of.dtype, of.tail, of.row_bytes) for name, of in array_fields(Message).items()}
    assert found == {
        "plain": (np.dtype("<f8"), (), 8),
        "aliased": (np.dtype("<i4"), (), 4),
        "swapped": (np.dtype("<f4"), (4,), 16),
        "nested": (np.dtype("|u1"), (3,), 3),
    }
