"""Records of one size in binary files: reading them in blocks, and what may follow the last one."""

from collections.abc import Iterator
from io import BufferedReader
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime.interrupts import check_interrupt
from .scan import BLOCK_BYTES, scan_error

# Bytes that may follow the last record of a binary file: zeros, blanks, and the end of a text in
# DOS.
BLANKS = b"\0 \t\r\n\x1a"
# Bytes searched for others per read.
SEARCHED_BYTES = 1 << 16


def read_records(
    file: BufferedReader, path: Path, record: np.dtype[Any], count: int, block_points: int, what: str
) -> Iterator[NDArray[Any]]:
    """Read `count` records of one size from the current file position, in blocks of bounded memory.

    what: plural noun for the records, used in the error message.
    Yields (n,) of `record`, n > 0; the next block overwrites it. Raises ScanError where the file
    ends early.
    """
    step = max(1, min(block_points, count, BLOCK_BYTES // record.itemsize))
    # One buffer serves all blocks: page faults of fresh memory per block cost as much as the copy
    # into it.
    buffer = np.empty(step, record)
    raw = buffer.view(np.uint8).data
    for seen in range(0, count, step):
        wanted = min(step, count - seen)
        # readinto() of a buffered file returns less than requested only at the end of the file.
        got = file.readinto(raw[: wanted * record.itemsize]) // record.itemsize
        if got < wanted:
            raise scan_error(
                path,
                f"the file ends {count - seen - got} {what} too soon",
                "as many as its header declares",
                "fetch the file again, it is truncated",
            )
        yield buffer[:wanted]


def check_end(file: BinaryIO, path: Path, what: str) -> None:
    """Refuse a file that continues after the records that its header declares.

    A count that is too small, or 0, would leave out the points behind it without notice. Zeros and
    blanks may follow: some writers fill the last page with zeros, others end it as a text.

    file: at the end of the declared records.  what: plural noun for these, used in the message.
    Raises ScanError.
    """
    while data := file.read(SEARCHED_BYTES):
        check_interrupt()
        if data.strip(BLANKS):
            raise scan_error(
                path,
                f"data behind the {what} that its header declares",
                "the end of the file",
                "fetch the file again, the count in its header may be damaged",
            )
