"""Clients of one scene that have a liveliness token. Independent of zenoh.

Each of them has its own turn in the fair queues; all clients without a token share one. zenoh does
not report which session a query comes from: `Query.source_info` holds what the sender put there, by
default nothing.
"""

# Turn of all clients without a liveliness token; no client has this name.
ANONYMOUS = ""


class Tokens:
    """Tokens of one scene's clients. One thread calls `here` and `gone`; any thread reads.

    Any process can declare any number of tokens, so their number is bounded: the first `most` are
    heeded, and as many more wait until one of the heeded tokens disappears. A client whose token is
    not heeded is treated as one without a token.
    """

    def __init__(self, most: int) -> None:
        """Begin without tokens. most: tokens that are heeded at a time."""
        self._most = most
        self._heeded: dict[str, None] = {}
        self._waiting: dict[str, None] = {}  # in order of arrival

    def here(self, client: str) -> None:
        """Record that the token of a client has appeared."""
        if client in self._heeded or len(self._heeded) < self._most:
            self._heeded[client] = None
        elif len(self._waiting) < self._most:
            self._waiting[client] = None

    def gone(self, client: str) -> None:
        """Record that the token of a client has disappeared."""
        self._waiting.pop(client, None)
        if client not in self._heeded:
            return
        del self._heeded[client]
        if self._waiting:
            following = next(iter(self._waiting))
            del self._waiting[following]
            self._heeded[following] = None

    def turn(self, client: str) -> str:
        """Return the turn of a client: its own name, or that of all clients without a token."""
        return client if client in self._heeded else ANONYMOUS

    @property
    def heeded(self) -> frozenset[str]:
        """Return the clients that have their own turn."""
        return frozenset(self._heeded)
