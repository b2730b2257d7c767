"""Registry of the avatars of a scene and of its clients, with limits on number and memory."""

import threading
import time
from collections.abc import Collection
from contextlib import nullcontext

import numpy as np
from msgspec import structs

from ...schemas.errors import BadRequestError, TooLargeError, UnknownAvatarError
from ...schemas.wire.encoding import avatar_digest
from ...schemas.wire.key_expressions import check_name
from ...schemas.wire.requests import AddAvatarRequest, check_avatar_name
from ...schemas.wire.stats import AvatarStats
from ..scene_interface import EVERYBODY, THIS_PROCESS, AvatarLimits, record_avatar
from .avatar_model import AvatarModel, make_avatar

# Upper bounds of an avatar's arrays [bytes]: for each point (53.5 measured), and for the single
# block of an avatar of a few points.
_BYTES_A_POINT, _LEAST_BYTES = 56, 1200
_OWN = (EVERYBODY, THIS_PROCESS)
# Avatars of more points are built one at a time, because building takes three times their bytes.
_LARGE = 50_000


class _Entry:
    """Avatar in the registry.

    asked: radius in the request that added it [m].  bytes: of its arrays.  used: time of the last
    use [s].
    """

    __slots__ = ("asked", "bytes", "model", "used")

    def __init__(self, model: AvatarModel, asked: float | None, size: int) -> None:
        self.model, self.asked, self.bytes, self.used = model, asked, size, time.monotonic()


def check_owner(client: str) -> None:
    """Raise BadRequestError unless an avatar's owner is a client, this process or the product itself.

    Owners that begin with "*", such as `EVERYBODY`, are of the product, and cannot be those of
    clients.
    """
    if client != THIS_PROCESS and not str(client).startswith(EVERYBODY):
        check_name(client, "client")


class Avatars:
    """Avatars by client and name. Thread-safe.

    limits: None for no limits. Avatars owned by `EVERYBODY` (the scene file's) and `THIS_PROCESS`
    are never dropped, limited or counted.
    """

    def __init__(self, limits: AvatarLimits | None = None) -> None:
        """Make an empty registry."""
        self.limits = limits
        self._lock = threading.RLock()
        self._large = threading.Lock()  # held while a large avatar is built
        self._clients: dict[str, dict[str, _Entry]] = {}

    def get(self, name: str, client: str) -> AvatarModel:
        """Return an avatar of a client or of the scene, and record its use.

        Raise UnknownAvatarError, or BadRequestError for names that no avatar or client can have.
        """
        try:
            with self._lock:
                for owner in (client, EVERYBODY):
                    entry = self._clients.get(owner, {}).get(name)
                    if entry is not None:
                        entry.used = time.monotonic()
                        record_avatar(entry.model.digest)
                        return entry.model
        except TypeError:  # an array given as a name has no hash
            check_avatar_name(name)
        check_avatar_name(name)
        check_owner(client)
        raise UnknownAvatarError(f"avatar {name!r} is not known: add it with add_avatar first")

    def provide(self, name: str, model: AvatarModel) -> None:
        """Store an avatar of the scene file, for all clients."""
        with self._lock:
            self._clients.setdefault(EVERYBODY, {})[name] = _Entry(model, model.radius, bytes_of(model))

    def add(self, request: AddAvatarRequest, client: str) -> AvatarModel:
        """Build an avatar and store it, unless the same one exists already.

        An avatar with the name of a scene avatar must equal it, and shares its arrays. Of two requests
        that add the same avatar at a time, both build it and one is stored. Raise BadRequestError if a
        name is invalid or belongs to a different avatar, TooLargeError beyond the limits.
        """
        check_owner(client)
        name, count = request.name, len(request.points)
        with self._lock:
            entry = self._clients.get(client, {}).get(name)
            shared = self._clients.get(EVERYBODY, {}).get(name)
        if entry is None:
            if shared is None:
                self._check_room(name, client, count, _LEAST_BYTES + _BYTES_A_POINT * count)
                model = self._build(request, request.radius)
                size = bytes_of(model)
            else:
                self._check_same(shared, request)
                model, size = shared.model, _LEAST_BYTES
            if client != EVERYBODY:
                digest = avatar_digest(model.points, model.radius, model.inner_points)
                model = model._replace(digest=digest)
            with self._lock:
                entry = self._clients.get(client, {}).get(name)
                if entry is None:
                    self._check_room(name, client, count, size)
                    entry = self._clients.setdefault(client, {})[name] = _Entry(model, request.radius, size)
        self._check_same(entry, request)
        return entry.model

    def _build(self, request: AddAvatarRequest, radius: float | None) -> AvatarModel:
        with self._large if len(request.points) > _LARGE else nullcontext():
            return make_avatar(request.points, radius, request.inner_points)

    def _check_same(self, entry: _Entry, request: AddAvatarRequest) -> None:
        """Raise BadRequestError unless a known avatar has this content."""
        known, radius = entry.model, request.radius
        same = known.inner_points == request.inner_points and np.array_equal(known.points, request.points)
        if same and radius is None and entry.asked is not None:
            # One radius is given and one is the default of the points, which only building yields.
            radius = self._build(request, None).radius
        if not same or (radius is not None and radius != known.radius):
            raise BadRequestError(
                f"avatar {request.name!r} exists with other points or another radius: use another name"
            )

    def names(self) -> list[str]:
        """Return the names of the scene's avatars and of those added in this process, sorted."""
        with self._lock:
            return sorted({name for owner in _OWN for name in self._clients.get(owner, {})})

    def drop_client(self, client: str) -> None:
        """Drop the avatars of a client."""
        with self._lock:
            self._clients.pop(client, None)

    def drop_unused(self, alive: Collection[str], seconds: float) -> int:
        """Drop avatars unused for `seconds`, except of clients in `alive`. Return their number."""
        before, dropped = time.monotonic() - seconds, 0
        with self._lock:
            for client, entries in list(self._clients.items()):
                if client in _OWN or client in alive:
                    continue
                kept = {name: entry for name, entry in entries.items() if entry.used >= before}
                dropped += len(entries) - len(kept)
                self._clients[client] = kept
                if not kept:
                    del self._clients[client]
        return dropped

    def stats(self) -> AvatarStats:
        """Return the memory and number of all clients' avatars, and the limits."""
        limits, totals = self.limits, self._totals()
        if limits is None:
            return totals
        return structs.replace(
            totals,
            max_bytes=limits.bytes,
            max_bytes_by_client=limits.bytes_by_client,
            max_avatars=limits.avatars,
            max_avatars_by_client=limits.avatars_by_client,
            max_clients=limits.clients,
        )

    def _totals(self) -> AvatarStats:
        """Return the bytes and numbers of all clients' avatars, without the limits."""
        with self._lock:
            own = [entries for client, entries in self._clients.items() if client not in _OWN]
            each = [entry.bytes for entries in own for entry in entries.values()]
        return AvatarStats(sum(each), len(each), len(own))

    def _check_room(self, name: str, client: str, count: int, size: int) -> None:
        """Raise TooLargeError if an avatar of `count` points and `size` bytes more exceeds the limits."""
        limits = self.limits
        if limits is None or client in _OWN:
            return
        with self._lock:
            totals, own = self._totals(), self._clients.get(client, {})
            own_bytes = sum(entry.bytes for entry in own.values())
        for found, more, most, what, then in (
            (own_bytes, size, limits.bytes_by_client, "bytes of this client's avatars", "thin it out"),
            (len(own), 1, limits.avatars_by_client, "avatars of this client", "use one of them again"),
            (totals.bytes, size, limits.bytes, "bytes of all clients' avatars", "thin it out, or try again later"),
            (totals.avatars, 1, limits.avatars, "avatars of all clients", "try again later"),
            (totals.clients, not own, limits.clients, "clients with avatars", "try again later"),
        ):  # fmt: skip
            if found + more > most:
                raise TooLargeError(
                    f"avatar {name!r} of {count} points: {found} {what} exist, with this one {found + more}: "
                    f"at most {most} are allowed: {then}"
                )


def bytes_of(model: AvatarModel) -> int:
    """Return the memory of an avatar's arrays [bytes]."""
    arrays = [model.points, model.rows, *(each for each in model.arrays if isinstance(each, np.ndarray))]
    return sum(array.nbytes for array in arrays)
