"""The avatars of a `Client` as it added them, to be added again, and to be told from others of their names."""

import threading
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from ...schemas.errors import BadRequestError
from ...schemas.wire.arrays import Positions
from ...schemas.wire.encoding import avatar_digest, decode_answer, encode
from ...schemas.wire.requests import AddAvatarRequest
from ...schemas.wire.scene_messages import AvatarInfo


class Added(NamedTuple):
    """An avatar as it was added. points: (n, 3) [m].  radius: as asked [m]; None: as the points make it."""

    points: Positions
    radius: float | None

    def request(self, name: str) -> bytes:
        """Return the request that adds it."""
        return encode(AddAvatarRequest(name, self.points, self.radius))

    def is_same(self, other: "Added") -> bool:
        """Return whether two avatars are one."""
        return self.radius == other.radius and np.array_equal(self.points, other.points)


class AddedAvatars:
    """The avatars that a client added, by name. Thread-safe."""

    def __init__(self) -> None:
        """Begin without avatars."""
        self._lock = threading.Lock()
        self._avatars: dict[str, Added] = {}
        self._digests: dict[str, bytes] = {}  # of those whose radius is known

    def add(self, name: str, avatar: Added) -> bool:
        """Keep an avatar; return whether it is new. BadRequestError where the name is taken by another."""
        digest = None if avatar.radius is None else avatar_digest(avatar.points, avatar.radius)
        with self._lock:
            known = self._avatars.setdefault(name, avatar)
            if known is avatar and digest is not None:
                self._digests[name] = digest
        if not known.is_same(avatar):
            raise BadRequestError(
                f"avatar {name!r} was added with other points or another radius: choose another name"
            )
        return known is avatar

    def remove(self, name: str) -> None:
        """Forget an avatar."""
        with self._lock:
            self._avatars.pop(name, None)
            self._digests.pop(name, None)

    def accepted(self, name: str, answer: bytes) -> AvatarInfo:
        """Return what the server says of an avatar that it took, and keep the radius."""
        info = decode_answer(AvatarInfo, answer)
        avatar = self._avatars.get(name)
        if avatar is not None and name not in self._digests and info.radius is not None:
            self._digests[name] = avatar_digest(avatar.points, info.radius)
        return info

    def known(self, names: Sequence[str]) -> dict[str, Added]:
        """Return those of these names, each once."""
        with self._lock:
            return {name: self._avatars[name] for name in names if name in self._avatars}

    def about(self, names: Sequence[str]) -> bytes | None:
        """Return the digests of avatars, joined: of each name in its order, none of a name that was not added.

        None: the server has not said the radius of one yet.
        """
        found = []
        for name in names:
            digest = self._digests.get(name)
            if digest is not None:
                found.append(digest)
            elif name in self._avatars:
                return None
        return b"".join(found)
