"""Warming of scenes: every query is run once, so that its kernels are compiled before a client asks.

A server warms `collide` before it listens, and the other parts (schemas/wire/warming_parts.py) while
it answers. Where all kernels are in their files, the first request of a part reads them if it comes
before its turn, in some 10 ms. Where kernels are compiled, such a request is refused as `busy`: it
would wait for seconds. Its part then comes next.
"""

import logging
import threading
from collections.abc import Callable, Sequence

from ...schemas.errors import BusyError
from ...schemas.runtime.compiling import has_compiled
from ...schemas.wire.warming_parts import PARTS
from ..runtime.stop_flag import start_deadlines
from ..scene_interface import ServedScene

log = logging.getLogger(__name__)


class Warming:
    """Warming of the scenes of a server. Thread-safe. Until it begins, nothing is refused.

    scenes: none is warm.  compiles: returns whether this process compiles kernels.
    left: parts that are not warm, the next one first.
    """

    def __init__(self, scenes: Sequence[ServedScene], compiles: Callable[[], bool] = has_compiled) -> None:
        self._scenes, self._compiles = scenes, compiles
        self._lock = threading.Lock()
        self.left: list[str] = []
        self._ended = False

    def run(self) -> None:
        """Warm everything. Raise SolidcloudError if a scene cannot be read."""
        self.run_first()
        while self.left:
            self._warm(self.left[0])

    def run_first(self) -> None:
        """Warm what is needed before the first request. Raise SolidcloudError as `run`."""
        start_deadlines()
        self.left = list(PARTS)
        for scene in self._scenes:
            log.info("warming %s", scene.name)
        self._warm(PARTS[0])

    def run_rest(self) -> bool:
        """Warm the other parts until `end`; return whether none is left.

        Errors are logged; requests will meet them again.
        """
        while self.left and not self._ended:
            part = self.left[0]
            try:
                self._warm(part)
            except Exception:
                log.exception("cannot warm %s", part)
                self._done(part)
        return not self.left

    def end(self) -> None:
        """End `run_rest` after the part in work."""
        self._ended = True

    @property
    def compiling(self) -> list[str]:
        """Return the parts that `check` refuses, the next one first."""
        return list(self.left) if self._compiles() else []

    def check(self, *parts: str) -> None:
        """Raise BusyError if a part is not ready, and let it be the next one."""
        if not self.left or not self._compiles():
            return
        with self._lock:
            missing = [part for part in parts if part in self.left]
            if not missing:
                return
            now, *later = self.left
            self.left = list(dict.fromkeys([now, *missing, *later]))
            count = len(self.left)
        raise BusyError(
            f"{' and '.join(missing)} not ready: this server compiles its kernels, once on this computer; "
            f"{count} of {len(PARTS)} parts are left: ask again in some seconds"
        )

    def _warm(self, part: str) -> None:
        for scene in self._scenes:
            scene.warm(part)
        self._done(part)

    def _done(self, part: str) -> None:
        with self._lock:
            self.left = [other for other in self.left if other != part]
