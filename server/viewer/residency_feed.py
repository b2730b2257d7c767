"""Changes of which voxels are in the server's memory, from one stream for all browsers."""

import logging
import threading
from collections.abc import Callable
from types import TracebackType
from typing import Self

import numpy as np

from ...schemas.errors import SolidcloudError
from ...schemas.wire.residency_messages import ResidencyChanges
from .page_messages import binary_message
from .scene_link import OpenScene

log = logging.getLogger(__name__)

# How long a stream may be silent before the thread looks whether it should end, and the interval of
# attempts to begin one [s].
_SILENT_SECONDS, _RETRY_SECONDS = 1.0, 0.5


class ResidencyFeed:
    """Stream of changes that browsers follow; a context manager, thread-safe."""

    def __init__(self, scene: Callable[[], OpenScene | None]) -> None:
        """Make a feed. scene: returns the scene that is shown."""
        self._scene = scene
        self._listeners: dict[int, Callable[[bytes], None]] = {}
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="viewer-residency", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._thread.join()

    def follow(self, number: int, listener: Callable[[bytes], None]) -> None:
        """Call a function with the message of each change, from the feed's thread; it must not wait."""
        with self._lock:
            self._listeners[number] = listener

    def leave(self, number: int) -> None:
        """Forget the function of a browser."""
        with self._lock:
            self._listeners.pop(number, None)

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

    def _tell(self, message: bytes) -> None:
        """Give a message to all browsers."""
        with self._lock:
            listeners = list(self._listeners.values())
        for listener in listeners:
            listener(message)


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
