"""LZF decompression as a forkable stream of bounded memory; PCD stores its columns one after the other."""

import copy
from io import BufferedReader
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime.interrupts import check_interrupt
from ...kernels.points.lzf_decoder import FARTHEST_BACK, LONGEST_CODE, LONGEST_COPY, decode
from ..common.scan import damaged_error

PIECE_BYTES = 1 << 18


class LzfStream:
    """Decompressed content of a byte range of a file, read from the start.

    A copy made by `fork` continues from the same position independently. This allows columns stored
    one after the other to be read side by side. A stream holds one piece of the file and one of the
    result, 1/2 MiB together.
    """

    def __init__(self, path: Path, start: int, past: int) -> None:
        """Open the compressed bytes [start, past) of the file."""
        self._path, self._at, self._past = path, start, past
        self._source = np.empty(0, np.uint8)
        self._out = np.empty(FARTHEST_BACK + PIECE_BYTES + LONGEST_COPY, np.uint8)
        self._have = self._given = 0

    def fork(self) -> "LzfStream":
        """Return an independent stream at the same position."""
        other = copy.copy(self)
        other._out = self._out.copy()
        return other

    def read(self, file: BufferedReader, count: int) -> NDArray[np.uint8]:
        """Return the next `count` bytes, (count,). Raises ScanError.

        file: the open file; its position is used.
        """
        result = np.empty(count, np.uint8)
        seen = 0
        while seen < count:
            part = self._next(file, count - seen)
            result[seen : seen + len(part)] = part
            seen += len(part)
        return result

    def skip(self, file: BufferedReader, count: int) -> None:
        """Skip the next `count` bytes. Parameters and errors as in `read`."""
        while count:
            count -= len(self._next(file, count))

    def _next(self, file: BufferedReader, most: int) -> NDArray[np.uint8]:
        """Return a view of 1 to `most` of the next bytes; the next call overwrites it."""
        if self._given == self._have:
            self._decode(file)
        begin = self._given
        self._given = min(self._have, begin + most)
        return self._out[begin : self._given]

    def _decode(self, file: BufferedReader) -> None:
        """Decode the next piece, keeping the bytes that a back-reference can reach before it."""
        check_interrupt()
        kept = min(self._have, FARTHEST_BACK)
        self._out[:kept] = self._out[self._have - kept : self._have]
        if len(self._source) < LONGEST_CODE and self._at < self._past:
            file.seek(self._at)
            data = file.read(min(PIECE_BYTES, self._past - self._at))
            self._at = self._at + len(data) if data else self._past
            self._source = np.concatenate([self._source, np.frombuffer(data, np.uint8)])
        at, self._have, right = decode(
            self._source, 0, len(self._source), self._out, kept, FARTHEST_BACK + PIECE_BYTES
        )
        self._source, self._given = self._source[at:], kept
        if not right or self._have == kept:
            raise damaged_error(
                self._path,
                "compressed data that ends too soon, or refers to bytes before its beginning",
                "LZF of as many bytes as its header declares",
            )
