"""Avatars that answer the current request: a thread notes the digest of each that it looks up.

The seal of a reply names them (WIRE.md, "Seals"), so a client can tell whether its own avatars
answered. They are noted at the lookup, because an avatar may be dropped and another added under its
name while the answer is computed.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager


class _Noted(threading.local):
    digests: list[bytes] | None = None


_NOTED = _Noted()


@contextmanager
def noted(digests: list[bytes]) -> Iterator[None]:
    """Have `note` append to `digests` in this thread, for a `with`."""
    before, _NOTED.digests = _NOTED.digests, digests
    try:
        yield
    finally:
        _NOTED.digests = before


def note(digest: bytes) -> None:
    """Note the digest of an avatar that was looked up; ignore the empty one of a scene's own."""
    if digest and _NOTED.digests is not None:
        _NOTED.digests.append(digest)
