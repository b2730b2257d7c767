"""Streaming writer of a record's dataset, for voxels that are too large to hold in memory."""

import mmap
import os
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import BadRequestError, CorruptError
from .zstd_frame import ANY_EXPANSION, Expansion, new_compressor, planes_of, sparse_frame

# Block size for compressing a frame that is not held in memory. The frame's bytes may depend on it.
STREAM_BYTES = 1 << 20
# The index stores a frame's length in 32 bits (FORMAT.md).
MAX_FRAME_BYTES = (1 << 32) - 1


class RowStream:
    """Dataset of a record whose rows arrive in parts, in any order.

    The byte planes are collected in a file and then compressed to one frame. The frame's bytes
    depend on the rows, not on the parts. They differ from those of `encode_voxel`, which has all
    rows at once. The temporary files have no name and disappear with the process.
    """

    def __init__(
        self, scratch: Path, dtype: np.dtype, rows: int, expansion: Expansion = ANY_EXPANSION
    ) -> None:
        """Create a file for `rows` rows in the folder `scratch`.

        expansion: limit that the frame keeps.
        """
        self._scratch, self._dtype, self._rows, self._expansion = scratch, dtype, rows, expansion
        self._planes = tempfile.TemporaryFile(dir=scratch, buffering=0)  # noqa: SIM115  `frame` closes it

    def put(self, first: int, rows: NDArray) -> None:
        """Store rows, beginning at row `first`."""
        for number, plane in enumerate(planes_of(rows.astype(self._dtype, copy=False))):
            pwrite_all(self._planes.fileno(), plane, number * self._rows + first)

    def frame(self) -> mmap.mmap:
        """Compress all rows to a frame.

        Raises BadRequestError for a frame too long for the index, CorruptError if rows are missing
        at the end.
        """
        with self._planes as planes, tempfile.TemporaryFile(dir=self._scratch, buffering=0) as file:
            size = self._rows * self._dtype.itemsize
            written = _write_pieces(file.fileno(), _dense_frame(self._parts(planes.fileno()), size))
            if not self._expansion.allows(size, written):
                file.truncate(0)
                pieces = sparse_frame(self._parts(planes.fileno()), size, self._expansion.ratio)
                written = _write_pieces(file.fileno(), pieces)
            if written > MAX_FRAME_BYTES:
                raise BadRequestError(
                    f"a voxel of {self._rows} rows takes {written} bytes, a record holds {MAX_FRAME_BYTES}: "
                    "give a smaller --voxel"
                )
            return mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)

    def _parts(self, planes: int) -> Iterator[bytes]:
        """Yield the planes from the file, STREAM_BYTES at a time.

        Raises CorruptError if they end early.
        """
        size = self._rows * self._dtype.itemsize
        for at in range(0, size, STREAM_BYTES):
            wanted = min(STREAM_BYTES, size - at)
            part = os.pread(planes, wanted, at)
            if len(part) != wanted:
                raise CorruptError(
                    f"the planes of {self._rows} rows end at byte {at + len(part)}, expected {size}: check the disk"
                )
            yield part


def _dense_frame(parts: Iterable[bytes], size: int) -> Iterator[bytes]:
    """Yield the bytes of a zstd frame over parts, `size` bytes in all."""
    stream = new_compressor().compressobj(size=size)
    for part in parts:
        yield stream.compress(part)
    yield stream.flush()


def _write_pieces(descriptor: int, pieces: Iterable[bytes]) -> int:
    """Write pieces one after another from the beginning of a file; return the number of bytes."""
    written = 0
    for piece in pieces:
        written += pwrite_all(descriptor, piece, written)
    return written


def pwrite_all(descriptor: int, data: bytes | NDArray, at: int) -> int:
    """Write all of the data at an offset of a file; return the number of bytes."""
    left = memoryview(data if isinstance(data, bytes) else data.data).cast("B")
    size = len(left)
    while left:
        written = os.pwrite(descriptor, left, at)
        at, left = at + written, left[written:]
    return size
