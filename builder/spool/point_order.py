"""Order of points at one position by their columns, which makes the order of all points unique.

The order is by scan, intensity, colour (red, green, blue) and class. Colour and class of a point are
also packed into one number, its *look*: where they are carried and compared only.
"""

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray


def sort_keys(columns: Mapping[str, NDArray | None]) -> tuple[NDArray, ...]:
    """Return the sort keys of points within a Morton code, as `canonical_columns`; None: no column."""
    keys = [columns.get(name) for name in ("intensity", "scan_index")]
    if columns.get("rgb") is not None or columns.get("classification") is not None:
        keys.insert(0, packed_look(columns.get("rgb"), columns.get("classification")))
    return tuple(key for key in keys if key is not None)


def packed_look(
    rgb: NDArray[np.uint8] | None, classification: NDArray[np.uint8] | None
) -> NDArray[np.uint32]:
    """Return colours (n, 3) and classes (n,), not both None, as one number each; a missing column is 0."""
    if rgb is None:
        assert classification is not None
        return classification.astype(np.uint32)
    red, green, blue = rgb.astype(np.uint32).T
    look = np.asarray(red << 24 | green << 16 | blue << 8, np.uint32)
    return look if classification is None else look | classification.astype(np.uint32)


def unpack_look(look: NDArray[np.uint32], rows: NDArray) -> None:
    """Write what `packed_look` returned into the columns that rows (n,) have."""
    if "rgb" in (rows.dtype.names or ()):
        for channel, shift in enumerate((24, 16, 8)):
            rows["rgb"][:, channel] = look >> np.uint32(shift) & np.uint32(255)
    if "classification" in (rows.dtype.names or ()):
        rows["classification"] = look & np.uint32(255)
