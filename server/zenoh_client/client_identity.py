"""Identity of a client on its server: an id with a liveliness token, and the avatars it added."""

import threading
import uuid
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import zenoh

from ...schemas.errors import BadRequestError
from ...schemas.wire import key_expressions
from ...schemas.wire.arrays import Positions
from ...schemas.wire.encoding import avatar_digest, decode_answer, encode
from ...schemas.wire.requests import AddAvatarRequest
from ...schemas.wire.scene_messages import AvatarInfo

# How long the queries of some operations are kept open [s]. Each part of a path must arrive within
# the client's timeout, but all parts take longer. A reload opens an archive and fills a cache at
# some 100 MB/s.
OPEN_SECONDS = {"path": 3600.0, "reload": 600.0}


class ClientIdentity:
    """One id of a client, declared until `close`, with the queriers of its operations.

    id: a secret of 122 random bits. A program that knows it may send queries and motion commands in
    the client's name, and add avatars to a server that has just started. A client that detects this
    takes another id.
    """

    def __init__(self, session: zenoh.Session, scene: str, timeout: float) -> None:
        """Make an id and declare it. timeout: time limit of a request [s]."""
        self.id = uuid.uuid4().hex
        self.keys = {
            operation: key_expressions.query_key(scene, self.id, operation)
            for operation in key_expressions.operations()
        }
        # A querier is declared once and keeps its route, which `Session.get` looks up every time.
        # Queriers are not undeclared explicitly, because that raises "Already borrowed" while
        # another thread uses one. zenoh undeclares each when its last reference is dropped.
        self.queriers = {
            operation: session.declare_querier(
                key,
                # By default, zenoh holds a reply back until the server has ended the query.
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=max(timeout, OPEN_SECONDS.get(operation, 0.0)),
            )
            for operation, key in self.keys.items()
        }
        # The token disappears with this process, even if it is killed. The server then drops the
        # client's avatars.
        self._token = session.liveliness().declare_token(key_expressions.client_token_key(scene, self.id))

    def close(self) -> None:
        """Undeclare the id; the server then drops its avatars."""
        self._token.undeclare()

    def is_in(self, key_expression: str) -> bool:
        """Return whether a key expression contains this id."""
        return self.id in key_expression.split("/")


class AddedAvatar(NamedTuple):
    """Avatar as it was added.

    points: (n, 3) [m].  radius: as requested [m]; None: the server derives it from the points.
    inner_points: number of them inside, the last ones.
    """

    points: Positions
    radius: float | None
    inner_points: int = 0

    def request(self, name: str) -> bytes:
        """Return the request that adds the avatar."""
        return encode(AddAvatarRequest(name, self.points, self.radius, self.inner_points))

    def is_same(self, other: "AddedAvatar") -> bool:
        """Return whether two avatars are equal."""
        same = (self.radius, self.inner_points) == (other.radius, other.inner_points)
        return same and np.array_equal(self.points, other.points)

    def digest(self, radius: float) -> bytes:
        """Return its digest with a radius [m]."""
        return avatar_digest(self.points, radius, self.inner_points)


class AddedAvatars:
    """Avatars that a client added, by name, with their digests. Thread-safe."""

    def __init__(self) -> None:
        """Begin without avatars."""
        self._lock = threading.Lock()
        self._avatars: dict[str, AddedAvatar] = {}
        self._digests: dict[str, bytes] = {}  # of those whose radius is known

    def add(self, name: str, avatar: AddedAvatar) -> bool:
        """Store an avatar; return whether it is new.

        Raise BadRequestError if another avatar has the name.
        """
        digest = None if avatar.radius is None else avatar.digest(avatar.radius)
        with self._lock:
            known = self._avatars.setdefault(name, avatar)
            if known is avatar and digest is not None:
                self._digests[name] = digest
        if not known.is_same(avatar):
            raise BadRequestError(
                f"avatar {name!r} was added with other points or another radius: choose another name"
            )
        return known is avatar

    def names(self) -> list[str]:
        """Return the names of the avatars, sorted."""
        with self._lock:
            return sorted(self._avatars)

    def remove(self, name: str) -> None:
        """Remove an avatar."""
        with self._lock:
            self._avatars.pop(name, None)
            self._digests.pop(name, None)

    def accepted(self, name: str, answer: bytes) -> AvatarInfo:
        """Decode the server's answer to the request that added an avatar, and store the radius."""
        info = decode_answer(AvatarInfo, answer)
        avatar = self._avatars.get(name)
        if avatar is not None and name not in self._digests and info.radius is not None:
            self._digests[name] = avatar.digest(info.radius)
        return info

    def known(self, names: Sequence[str]) -> dict[str, AddedAvatar]:
        """Return the avatars that were added under some of these names, by name."""
        with self._lock:
            return {name: self._avatars[name] for name in names if name in self._avatars}

    def digests(self, names: Sequence[str]) -> bytes | None:
        """Return the joined digests of avatars in the order of the names, without unknown names.

        Return None if the radius of one is not known yet.
        """
        found = []
        for name in names:
            digest = self._digests.get(name)
            if digest is not None:
                found.append(digest)
            elif name in self._avatars:
                return None
        return b"".join(found)
