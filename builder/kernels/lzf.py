"""Decoding of LZF, the compression of PCD files, a piece at a time: a loop in Python takes 1 us a byte."""

import numpy as np

from ...schemas.kernels import compiling as nb

# A reference copies at most this many bytes, from at most so far back [liblzf, lzf_d.c].
LONGEST_COPY = 264
FARTHEST_BACK = 1 << 13
# Bytes that one step of the code takes at most: 32 literal bytes and their number.
LONGEST_CODE = 33


@nb.njit(cache=True, nogil=True)
def decode(source, at, past, out, have, limit):
    """Decode whole steps of LZF from source[at:past] into `out` behind its first `have` bytes; both (n,) uint8.

    Stops where fewer than LONGEST_CODE bytes are left of the source, unless `past` is its end (then where a step
    does not fit), or at least `limit` bytes are there; `out` must have room for limit + LONGEST_COPY.
    Returns (where it stands in the source, bytes in `out`, whether all was right): a reference to before the first
    byte of `out` is not. Writes only to `out`.
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
        for k in range(count):  # byte by byte: what is copied may be what was just written
            out[have + k] = out[begin + k]
        at += taken
        have += count
    return at, have, True
