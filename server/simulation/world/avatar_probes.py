"""Queries of each avatar that a thread has moved: `ResidentQueries` are not thread-safe."""

from collections import OrderedDict

from ...avatars.avatar_model import AvatarModel
from ...queries.resident_fast_path import ResidentQueries

# Limit on the avatars (of users and objects) for which a thread keeps a `ResidentQueries`.
_MAX_PROBES = 256
# Limit on the points of these avatars, some 100 MB a thread: those of dropped avatars also count.
_MAX_PROBED_POINTS = 1 << 20


class AvatarProbes:
    """The last avatars of one thread, each with its `ResidentQueries`."""

    def __init__(self) -> None:
        self._probes: OrderedDict[int, ResidentQueries] = OrderedDict()
        self._points = 0

    def of(self, avatar: AvatarModel) -> ResidentQueries:
        """Return the `ResidentQueries` of an avatar."""
        probes, key = self._probes, id(avatar.points)
        probe = probes.get(key)
        if probe is None or probe.avatar.arrays is not avatar.arrays or probe.avatar.radius != avatar.radius:
            if probe is not None:
                self._points -= len(probes.pop(key).avatar.points)
            probe = probes[key] = ResidentQueries(avatar)
            self._points += len(avatar.points)
            while len(probes) > 1 and (len(probes) > _MAX_PROBES or self._points > _MAX_PROBED_POINTS):
                _, oldest = probes.popitem(last=False)
                self._points -= len(oldest.avatar.points)
        return probe
