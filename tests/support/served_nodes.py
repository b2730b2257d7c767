"""Nodes as a server holds them: which points a row of the arena encloses, in fractions."""

from collections.abc import Sequence
from fractions import Fraction


def row_encloses(row: Sequence[Fraction], point: Sequence[Fraction]) -> bool:
    """Return whether a point lies in the sphere of a row, and in its slab or its box.

    row: its first ten words, exactly (server/kernels/core/scene_arrays.py, node_bounds.py).
    point: in steps from the voxel's low corner.
    """
    apart = [p - c for p, c in zip(point, row[:3], strict=True)]
    if sum((d * d for d in apart), Fraction(0)) > row[3] ** 2:
        return False
    if row[7] < 0:
        return all(abs(d) <= half for d, half in zip(apart, row[4:7], strict=True))
    along = sum((n * d for n, d in zip(row[4:7], apart, strict=True)), Fraction(0))
    return not any(row[4:7]) or row[8] <= along <= row[9]
