"""Write a run of the spool from rows in any order."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from solidcloud.builder.spool.run_files import canonical_columns, new_run, row_codes, write_directory


def write_run(path: Path, keys: NDArray[np.uint64], rows: NDArray) -> None:
    """Sort rows (n,) and write them as the run `path` (NAME.run). n >= 1.

    keys: (n,) voxel of each row.
    """
    order = np.lexsort((*canonical_columns(rows), row_codes(rows), keys))
    rows, keys = rows[order], keys[order]
    found, starts = np.unique(keys, return_index=True)
    with new_run(path) as file:
        file.write(rows.tobytes())
    write_directory(path, found, np.append(starts, len(keys)).astype(np.int64))
