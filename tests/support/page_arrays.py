"""Binary messages of the viewer as its page reads them."""

import json

import numpy as np


def decoded(message: bytes) -> tuple[dict, dict[str, np.ndarray]]:
    """Return header and arrays of a binary message, as the page reads them."""
    length = int.from_bytes(message[:4], "little")
    header = json.loads(message[4 : 4 + length])
    assert (4 + length) % 8 == 0
    arrays = {}
    for name, (kind, shape, first) in header.pop("arrays").items():
        assert first % 8 == 0
        count = int(np.prod(shape))
        arrays[name] = np.frombuffer(message, f"<{kind}", count, 4 + length + first).reshape(shape)
    return header, arrays
