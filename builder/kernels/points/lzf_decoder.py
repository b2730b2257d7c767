"""Decoding of LZF, the compression of PCD files, piece by piece; a loop in Python takes 1 us a byte."""

import numpy as np

from ....schemas.runtime import compiling as nb

# A reference copies at most this many bytes, from at most this far back [liblzf, lzf_d.c].
LONGEST_COPY = 264
FARTHEST_BACK = 1 << 13
# Maximum bytes of one code: 32 literal bytes and their count.
LONGEST_CODE = 33


@nb.njit(cache=True, nogil=True)
def decode(source, at, past, out, have, limit):
    """Decode whole LZF codes from source[at:past] into `out` after its first `have` bytes.

    source, out: (n,) uint8.
    Stops at `past`, before a code that does not fit before `past`, and when `out` holds at least
    `limit` bytes; `out` must have room for limit + LONGEST_COPY. Returns (position in the source,
    bytes in `out`, valid). valid is False for a reference to before the first byte of `out`. Writes
    only to `out`.
    """
    while at < past and have < limit:
        code = np.int64(source[at])
        if code < 32:
            count = code + 1
            if at + 1 + count > past:
                break
            for k in range(count):
                out[have + k] = source[at + 1 + k]
            at += 1 + count
            have += count
            continue
        count = (code >> 5) + 2
        taken = 2
        if code >> 5 == 7:
            taken = 3
            if at + taken > past:
                break
            count += np.int64(source[at + 1])
        if at + taken > past:
            break
        begin = have - ((code & 31) << 8) - np.int64(source[at + taken - 1]) - 1
        if begin < 0:
            return at, have, False
        for k in range(count):  # byte by byte: the ranges may overlap
            out[have + k] = out[begin + k]
        at += taken
        have += count
    return at, have, True
