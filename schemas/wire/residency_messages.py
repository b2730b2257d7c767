"""Message of the residency key: which voxels became resident, or were evicted, as it happens."""

from enum import IntEnum

import msgspec
import numpy as np

from .requests import Request
from .tile_messages import Voxels

# Interval at which changes are sent, and at which a message is sent without any [s].
CHANGES_SECONDS, SILENT_SECONDS = 0.1, 0.5
# Most voxels of a message, 15 bytes each. A server of two cores loads fewer in CHANGES_SECONDS.
MAX_CHANGED_VOXELS = 1024


class ResidencyRequest(Request, frozen=True):
    """Query for changes. An omitted payload means the defaults.

    follow: false ends the client's earlier query instead, and has no reply.
    """

    follow: bool = True


class Residency(IntEnum):
    """State of a voxel in `ResidencyChanges`."""

    EVICTED = 0
    LOADED = 1  # for a request
    PREFETCHED = 2  # loaded before any request
    WASTED = 3  # prefetched, and evicted without having been requested


class ResidencyChanges(msgspec.Struct, frozen=True):
    """State of the voxels whose state has changed since the message before.

    seq: number of the message, greater by 1 than that of the message before. A larger difference
    means that messages were lost on the way.
    lost: whether changes before this message may be missing. The client then asks for `voxels`
    again, after this message.
    archive, voxel: (n,) and (n, 3), as in `VoxelsAnswer`.  state: (n,), of `Residency`; only the
    last change of a voxel is listed.
    resident, resident_bytes: of the whole scene, including voxels that are being loaded.
    """

    seq: int
    lost: bool
    archive: np.ndarray[tuple[int], np.dtype[np.uint16]]
    voxel: Voxels
    state: np.ndarray[tuple[int], np.dtype[np.uint8]]
    resident: int = 0
    resident_bytes: int = 0
