"""The clients of one scene that have a liveliness token. No zenoh here.

Each of them has a turn of its own; all clients without a token count as one. zenoh does not tell which session a query
comes from: `Query.source_info` holds what the asker put there, by default nothing.
"""

# The turn of all clients without a liveliness token; no client's name.
ANONYMOUS = ""


class Tokens:
    """The tokens of one scene's clients. One thread calls `here` and `gone`; any thread reads.

    Anybody may declare any number of tokens, so that their number is bounded: the first `most` are heeded, and as many
    more are remembered and heeded once one of the first goes. A client whose token is not heeded is treated as one
    without a token.
    """

    def __init__(self, most: int) -> None:
        """most: tokens that are heeded at a time."""
        self._most = most
        self._heeded: dict[str, None] = {}
        self._waiting: dict[str, None] = {}  # in the order they came

    def here(self, client: str) -> None:
        """Note that the token of a client is there."""
        if client in self._heeded or len(self._heeded) < self._most:
            self._heeded[client] = None
        elif len(self._waiting) < self._most:
            self._waiting[client] = None

    def gone(self, client: str) -> None:
        """Note that the token of a client went."""
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
        """Return the clients that have a turn of their own."""
        return frozenset(self._heeded)
