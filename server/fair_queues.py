"""Whose request is answered next: one of each client at a time, the clients in turn. No zenoh here."""

import threading
from collections import deque
from enum import Enum
from typing import Any


class Offer(Enum):
    """What becomes of a request that was offered."""

    RUN = "run it now"
    WAIT = "it waits; whoever finishes takes it"
    FULL = "refused"


class FairQueues:
    """A queue for each client: one request of each in flight, the clients in turn, the whole bounded.

    Thread-safe. Every RUN is followed by `finished`, or by `detach` and `release`, and so is every request that these
    return; that is why nothing that waits is ever forgotten.
    """

    def __init__(self, workers: int, max_requests: int, max_bytes: int) -> None:
        self._lock = threading.Lock()
        self._workers, self._max_requests, self._max_bytes = workers, max_requests, max_bytes
        self._waiting: dict[str, deque[tuple[Any, int]]] = {}
        self._ready: deque[str] = deque()  # clients with something waiting and nothing in flight
        self._running: dict[str, int] = {}  # client: bytes of its request in flight
        self._requests = self._bytes = 0

    def offer(self, client: str, request: Any, size: int, *, always: bool = False) -> Offer:
        """Take in a request of `size` bytes; `always`: even where the bound is reached."""
        with self._lock:
            full = self._requests >= self._max_requests or self._bytes + size > self._max_bytes
            if full and self._requests and not always:
                return Offer.FULL
            self._requests += 1
            self._bytes += size
            if client not in self._running and len(self._running) < self._workers:
                self._running[client] = size
                return Offer.RUN
            if client not in self._waiting:
                self._waiting[client] = deque()
                if client not in self._running:
                    self._ready.append(client)
            self._waiting[client].append((request, size))
            return Offer.WAIT

    def finished(self, client: str) -> tuple[str, Any] | None:
        """The client's request in flight is answered. Returns the (client, request) to run next, if any."""
        size, following = self.detach(client)
        self.release(size)
        return following

    def detach(self, client: str) -> tuple[int, tuple[str, Any] | None]:
        """The client's request in flight goes on, but takes up neither a worker nor its client's turn.

        Returns its size, to be given to `release` once it is answered, and the (client, request) to run next, if any.
        """
        with self._lock:
            size = self._running.pop(client)
            if client in self._waiting:
                self._ready.append(client)
            if not self._ready:
                return size, None
            following = self._ready.popleft()
            request, following_size = self._waiting[following].popleft()
            if not self._waiting[following]:
                del self._waiting[following]
            self._running[following] = following_size
            return size, (following, request)

    def release(self, size: int) -> None:
        """A request of `size` bytes is answered."""
        with self._lock:
            self._requests -= 1
            self._bytes -= size

    def __len__(self) -> int:
        """Requests taken in and not yet finished."""
        with self._lock:
            return self._requests
