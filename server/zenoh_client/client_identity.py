"""Who a client is to its server: an id, its liveliness token, and what asks its questions under keys with the id."""

import uuid
from contextlib import ExitStack

import zenoh

from ...schemas.wire import key_expressions

# How long some queries are kept open [s]. Of a path; how long a part of it may take is the client's timeout. A reload
# opens an archive and fills a cache, at some 100 MB/s.
OPEN_SECONDS = {"path": 3600.0, "reload": 600.0}


class Identity:
    """One id of a client, declared until `close`.

    id: a secret of 122 random bits: whoever knows it may ask and wish in the client's name, and add avatars to a server
    that has just started. A client takes another where it finds that somebody did.
    """

    def __init__(self, session: zenoh.Session, scene: str, timeout: float) -> None:
        """Take a fresh id and declare it. timeout: of a question [s]."""
        self.id = uuid.uuid4().hex
        self.keys = {
            operation: key_expressions.query_key(scene, self.id, operation)
            for operation in key_expressions.operations()
        }
        with ExitStack() as stack:
            # Gone with this process, however it ends: then the server forgets our avatars.
            token = key_expressions.client_token_key(scene, self.id)
            stack.enter_context(session.liveliness().declare_token(token))
            # Declared once: a querier's route is known, an ad hoc `get` looks for it every time.
            self.queriers = {
                operation: stack.enter_context(
                    session.declare_querier(
                        key,
                        # By default zenoh keeps a reply back until the server has said that no other comes.
                        consolidation=zenoh.ConsolidationMode.NONE,
                        timeout=max(timeout, OPEN_SECONDS.get(operation, 0.0)),
                    )
                )
                for operation, key in self.keys.items()
            }
            self._stack = stack.pop_all()

    def close(self) -> None:
        """Have the server forget the id and its avatars."""
        self._stack.close()

    def asked(self, key_expression: str) -> bool:
        """Return whether a key expression has this id."""
        return self.id in key_expression.split("/")
