"""Lossless compression of packed rows to a zstd frame of their byte planes, at once or streamed.

This is the only module that uses zstandard. The frame has a checksum and contains the byte planes
of a packed compound array. This equals HDF5's standard shuffle filter followed by the registered
zstd filter 32015, so that any HDF5 tool reads typed rows. A `RowStream` writes the frame of a voxel
that is too large for memory.
"""

import mmap
import os
import tempfile
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import zstandard
from numpy.typing import NDArray

from ..errors import BadRequestError, CorruptError

# The low bytes are nearly random and do not compress; the high bytes repeat over long runs. Fewer
# and longer matches than those of level 3 decode the paper's voxel 0.6 ms faster, and save 2 % of
# the bytes.
_PARAMETERS = zstandard.ZstdCompressionParameters(
    compression_level=3,
    strategy=zstandard.STRATEGY_LAZY2,
    min_match=7,
    window_log=21,
    hash_log=10,
    chain_log=12,
    search_log=3,
    target_length=64,
    write_checksum=True,
    write_content_size=True,
)

_OF_THREAD = threading.local()

# A zstd frame in memory, or in a file that is deleted with the mapping.
Frame = bytes | mmap.mmap
# A block of zstd takes at least 3 bytes of header and 1 of content.
_MIN_BLOCK_BYTES = 4


def zstd_version() -> str:
    """Return the version of the zstd library."""
    return ".".join(map(str, zstandard.ZSTD_VERSION))


class Expansion(NamedTuple):
    """Limit of a frame's content size: `free` bytes or `ratio` per byte of the frame, if more."""

    free: int
    ratio: int

    def allows(self, size: int, frame: int) -> bool:
        """Return True if a frame of `frame` bytes may decompress to `size` bytes."""
        return size <= max(self.free, self.ratio * frame)


# The limit of zstd itself: a block takes at least 4 bytes and decompresses to at most 2^17.
ANY_EXPANSION = Expansion(0, 1 << 15)


def new_compressor() -> zstandard.ZstdCompressor:
    """Return a compressor with the parameters of all frames, for use by one thread."""
    return zstandard.ZstdCompressor(compression_params=_PARAMETERS)


def pack(rows: NDArray, expansion: Expansion = ANY_EXPANSION) -> bytes:
    """Compress the byte planes of a packed array (HDF5's shuffle) to one zstd frame.

    The frame has a checksum and declares its content size.
    expansion: limit that the frame keeps; rows that compress further are packed less densely.
    """
    planes = planes_of(rows)
    frame = new_compressor().compress(planes.data)
    if expansion.allows(planes.size, len(frame)):
        return frame
    return b"".join(sparse_frame([planes.data.cast("B")], planes.size, expansion.ratio))


def sparse_frame(parts: Iterable[bytes | memoryview], size: int, ratio: int) -> Iterator[bytes]:
    """Yield the bytes of a zstd frame that expands at most `ratio` times, by short blocks.

    parts: the content, `size` bytes in all.
    """
    stream = new_compressor().compressobj(size=size)
    for part in parts:
        for begin in range(0, len(part), _MIN_BLOCK_BYTES * ratio):
            yield stream.compress(part[begin : begin + _MIN_BLOCK_BYTES * ratio])
            yield stream.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)
    yield stream.flush()


def planes_of(rows: NDArray) -> NDArray[np.uint8]:
    """Return the byte planes (itemsize, n) of packed rows (n,)."""
    return np.ascontiguousarray(rows.view(np.uint8).reshape(len(rows), rows.dtype.itemsize).T)


def unpack(
    frame: bytes, dtype: np.dtype, count: int, what: str, kept: np.dtype | None = None
) -> NDArray[np.uint8]:
    """Return the byte planes (itemsize, count) that `pack` compressed, read-only.

    kept: if given, only the planes of its fields are returned.
    Raises CorruptError, naming `what`, for a frame that is damaged or does not hold `count` rows. A
    frame that declares another size is refused before memory is allocated for it.
    """
    expected = count * dtype.itemsize
    try:
        declared = zstandard.get_frame_parameters(frame)
        if declared.content_size != expected:
            raise CorruptError(f"{what}: frame of {declared.content_size} bytes, expected {expected}")
        # One flipped bit disables the checksum: the frame would be decoded unchecked, with its
        # checksum as extra bytes.
        if not declared.has_checksum:
            raise CorruptError(f"{what}: frame without checksum, expected one")
        if kept is not None and kept != dtype:
            return _unpack_fields(frame, dtype, count, kept)
        plain = _decompressor().decompress(frame, max_output_size=expected, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CorruptError(f"{what}: damaged frame ({error})") from error
    return np.frombuffer(plain, np.uint8).reshape(dtype.itemsize, count)


def _unpack_fields(frame: bytes, dtype: np.dtype, count: int, kept: np.dtype) -> NDArray[np.uint8]:
    """Return the byte planes of the fields of `kept`.

    The other fields are decompressed in pieces and discarded, because the checksum covers the whole
    frame. The caller has checked the declared size and that there is a checksum, which the stream
    does not require. Raises ZstdError.
    """
    planes = np.empty((kept.itemsize, count), np.uint8)
    past = np.empty(min(count, 1 << 16), np.uint8)
    stream = _decompressor().stream_reader(frame, read_across_frames=False)
    at = 0
    for name in dtype.names or ():
        width = dtype[name].itemsize
        wanted = name in (kept.names or ())
        parts = [planes[at + i] for i in range(width)] if wanted else _pieces(past, width * count)
        for part in parts:
            _fill(stream, part)
        at += width * wanted
    if stream.readinto(bytearray(1)):
        raise zstandard.ZstdError("more content than declared")
    planes.flags.writeable = False
    return planes


def _pieces(scratch: NDArray[np.uint8], size: int) -> Iterator[NDArray[np.uint8]]:
    """Yield `scratch`, or its beginning, as often as needed for `size` bytes."""
    for begin in range(0, size, len(scratch)):
        yield scratch[: size - begin]


def _fill(stream: zstandard.ZstdDecompressionReader, out: NDArray[np.uint8]) -> None:
    """Read exactly len(out) bytes; raise ZstdError if the stream ends early."""
    begin = 0
    while begin < len(out):
        read = stream.readinto(out[begin:].data)
        if not read:
            raise zstandard.ZstdError("content ends early")
        begin += read


def _decompressor() -> zstandard.ZstdDecompressor:
    """Return this thread's decompressor.

    Making one takes 0.1 ms, and two threads must not use the same one at a time.
    """
    found: zstandard.ZstdDecompressor | None = getattr(_OF_THREAD, "decompressor", None)
    if found is None:
        found = _OF_THREAD.decompressor = zstandard.ZstdDecompressor()
    return found


def column_of(planes: NDArray[np.uint8], dtype: np.dtype, field: str) -> NDArray:
    """Return one field of packed rows from their byte planes (itemsize, n).

    The shape is (n,), or (3, n) for a field of three components.
    """
    kind, at = dtype.fields[field][:2]  # type: ignore[index]  # compound, all of them
    n, size = planes.shape[1], kind.base.itemsize
    parts = planes[at : at + kind.itemsize].reshape(-1, size, n)  # HDF5's shuffle, low bytes first
    words = parts[:, 0].astype(f"u{size}")
    for b in range(1, size):
        words |= np.left_shift(parts[:, b], 8 * b, dtype=words.dtype)
    return words.view(kind.base).reshape(*kind.shape, n)


# Block size for compressing a frame that is not held in memory. The frame's bytes may depend on it.
STREAM_BYTES = 1 << 20
# The index stores a frame's length in 32 bits (FORMAT.md).
MAX_FRAME_BYTES = (1 << 32) - 1


class RowStream:
    """Dataset of a record whose rows arrive in parts, in any order.

    The byte planes are collected in a file and then compressed to one frame. The frame's bytes
    depend on the rows and not on the parts. They differ from those of `encode_voxel`, which
    compresses all rows at once. The temporary files have no name and disappear with the process.
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
