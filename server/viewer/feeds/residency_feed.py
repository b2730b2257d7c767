"""Changes of which voxels are in the server's memory, from one stream for all browsers."""

import logging
from collections.abc import Callable

import numpy as np

from ....schemas.errors import SolidcloudError
from ....schemas.wire.residency_messages import ResidencyChanges
from ..page.page_messages import binary_message
from .browser_feed import BrowserFeed
from .scene_link import OpenScene

log = logging.getLogger(__name__)

# How long a stream may be silent before the thread looks whether it should end, and the interval of
# attempts to begin one [s].
_SILENT_SECONDS, _RETRY_SECONDS = 1.0, 0.5


class ResidencyFeed(BrowserFeed[bytes]):
    """Stream of changes that browsers follow; a context manager, thread-safe."""

    def __init__(self, scene: Callable[[], OpenScene | None]) -> None:
        """Make a feed. scene: returns the scene that is shown."""
        super().__init__("viewer-residency")
        self._scene = scene

    def _run(self) -> None:
        """Read the stream for as long as browsers follow. Runs in a thread."""
        while not self._stop.wait(_RETRY_SECONDS):
            scene = self._scene()
            if scene is None or not self._listeners:
                continue
            try:
                with scene.reader.residency_changes() as stream:
                    while not self._stop.is_set() and self._listeners:
                        for changes in stream.changes(_SILENT_SECONDS):
                            self._tell(residency_message(changes))
                            if self._stop.is_set() or not self._listeners:
                                break
            except SolidcloudError as error:
                log.debug("no changes of residency: %s", error)


def residency_message(changes: ResidencyChanges) -> bytes:
    """Return changes as a message for the page."""
    keys = np.column_stack([changes.archive.astype(np.int32), changes.voxel]).astype(np.int32)
    return binary_message(
        "residency",
        {"key": keys, "state": changes.state},
        lost=changes.lost,
        resident=changes.resident,
        bytes=changes.resident_bytes,
    )
