"""Threads of the viewer that work for all browsers, and feeds: their messages to each browser."""

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Generic, Self, TypeVar

from ...runtime.threads import start_loop

Message = TypeVar("Message", str, bytes)


class BackgroundThread(ABC):
    """Thread that runs while its object is entered; a context manager."""

    def __init__(self, name: str) -> None:
        """Make a thread; entering the object starts it."""
        self._stop = threading.Event()
        self._name = name
        self._thread: threading.Thread | None = None

    def __enter__(self) -> Self:
        self._thread = start_loop(self._name, self._run)
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        if self._thread is not None:
            self._thread.join()

    @abstractmethod
    def _run(self) -> None:
        """Work until `_stop` is set. Runs in the thread."""


class BrowserFeed(BackgroundThread, Generic[Message]):
    """Messages that browsers follow; a context manager, thread-safe."""

    def __init__(self, name: str) -> None:
        """Make a feed. name: of its thread."""
        super().__init__(name)
        self._listeners: dict[int, Callable[[Message], None]] = {}
        self._lock = threading.RLock()

    def follow(self, number: int, listener: Callable[[Message], None]) -> None:
        """Call a function with each message from now on, from any thread; it must not wait.

        number: of the browser.
        """
        with self._lock:
            self._listeners[number] = listener

    def leave(self, number: int) -> None:
        """Forget the function of a browser."""
        with self._lock:
            self._listeners.pop(number, None)

    def _tell(self, message: Message) -> None:
        """Give a message to all browsers."""
        with self._lock:
            for listener in self._listeners.values():
                listener(message)
