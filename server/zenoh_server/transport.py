"""Transport of bytes over zenoh; the dispatcher interprets them.

zenoh passes queries to a bounded channel, from which the server's threads take them, because a
zenoh callback must not block. request_lanes.py holds the work of these threads.
"""

import logging
import os
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Any, Self

import zenoh

from ...schemas.errors import BadRequestError, SolidcloudError
from ...schemas.wire import key_expressions
from ..runtime.threads import start_thread
from ..zenoh_common.endpoints import zenoh_words
from ..zenoh_common.key_files import published_key
from ..zenoh_common.sealed_replies import encoding_of, sealer_of, send_reply
from ..zenoh_common.zenoh_settings import session_config
from .fair_queues import LivelinessTokens
from .request_dispatcher import RequestDispatcher
from .request_lanes import Lane
from .residency_streams import ResidencyStreams
from .server_config import ServerConfig
from .session_transport import SceneSessions

log = logging.getLogger(__name__)

# Capacity of the channel in queries. A full channel blocks zenoh's receiver, which bounds memory
# under overload. The threads empty it at once: they queue a query in `FairQueues` or answer `busy`.
_CHANNEL = 1024
# How long a stop waits, twice, for threads whose requests were stopped [s]. Kernels check the stop
# flag every few milliseconds; a reply that its client does not accept waits for
# `wait_before_close`.
_GIVE_UP_SECONDS = 0.4
# Interval at which a stop checks whether a thread about to start has started [s].
_NEXT_SECONDS = 0.001

# zenoh's sending threads, one by default. The thread that closes the link of a client that accepts
# no replies is blocked for `wait_before_close`; with one thread all other clients would wait.
_RUNTIME = "(tx: (worker_threads: 16))"


class Transport:
    """Carrier of requests to a dispatcher and of its answers back, inside a `with`.

    Entering raises SolidcloudError if the server cannot listen on the endpoint. Leaving stops
    accepting requests, answers the accepted ones for up to `config.stop_seconds`, stops the rest
    and closes.
    """

    def __init__(self, scenes: Sequence[str], dispatcher: RequestDispatcher, config: ServerConfig) -> None:
        self._scenes, self._dispatcher, self._config = tuple(scenes), dispatcher, config
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self._declared: list[Any] = []
        self._lanes: list[Lane] = []
        self._sessions: list[SceneSessions] = []
        self.left_at_work = False  # set on leaving if threads did not end in time

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            session = stack.enter_context(self._open())
            # The key is stored after opening the endpoint, which fails if another server is still
            # running: its key must not be overwritten.
            self._key = stack.enter_context(published_key(self._config.listen, self._config.key_file))
            for scene in self._scenes:
                stack.callback(self._declare_scene(session, scene).close)
            self._declare_scenes(session)
            # Tokens come last: a client that sees the token may send requests at once.
            for scene in self._scenes:
                key = key_expressions.server_token_key(scene, str(session.zid()))
                self._declared.append(session.liveliness().declare_token(key))
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            # Undeclare in reverse order, tokens first. The channel of an undeclared queryable still
            # yields its queries and then ends.
            for declared in reversed(self._declared):
                declared.undeclare()
            if not self._wait(self._config.stop_seconds):
                log.warning("stopping requests unanswered after %g s", self._config.stop_seconds)
                for lane in self._lanes:
                    lane.give_up()
                for sessions in self._sessions:
                    sessions.give_up()
                self._wait(_GIVE_UP_SECONDS)
        # Closing the session ends replies that wait for a client that accepts none. A thread inside
        # zenoh when the interpreter exits would abort the process.
        if not self._wait(_GIVE_UP_SECONDS):
            self.left_at_work = True
            log.error("stopped with threads still running")

    def _wait(self, seconds: float) -> bool:
        """Wait at most `seconds` for all requests and threads; return whether they have ended."""
        deadline = time.monotonic() + seconds
        while True:
            # A thread may have started another one, for a path, before it ended. If no thread is
            # left while requests are in flight, a watchdog is about to start the next.
            alive = [thread for thread in list(self._threads) if thread.is_alive()]
            if not alive and not any(lane.in_flight for lane in self._lanes):
                return True
            left = deadline - time.monotonic()
            if left <= 0:
                return False
            if alive:
                alive[0].join(left)
            else:
                time.sleep(_NEXT_SECONDS)

    def _open(self) -> zenoh.Session:
        """Open a session that listens; raise SolidcloudError if it cannot."""
        os.environ.setdefault("ZENOH_RUNTIME", _RUNTIME)  # read when the process opens its first session
        try:
            return zenoh.open(session_config(listen=self._config.listen))
        except zenoh.ZError as error:
            said = zenoh_words(error)
            hint = "is another server there? try another port" if "in use" in said else "try another endpoint"
            raise SolidcloudError(f"cannot listen on {self._config.listen}: {said}: {hint}") from None

    def _declare_scene(self, session: zenoh.Session, scene: str) -> Lane:
        """Answer requests for one scene, and watch clients connect and disconnect."""
        # history: includes clients that connected before.
        watch = session.liveliness().declare_subscriber(
            key_expressions.all_client_tokens_key(scene), zenoh.handlers.FifoChannel(_CHANNEL), history=True
        )
        self._declared.append(watch)
        queryable = session.declare_queryable(
            key_expressions.all_queries_key(scene), zenoh.handlers.FifoChannel(_CHANNEL), complete=True
        )
        self._declared.append(queryable)
        tokens = LivelinessTokens(self._config.max_in_flight)
        lane = Lane(self._dispatcher, scene, self._config, queryable.handler, self._start, self._key, tokens)
        self._lanes.append(lane)
        sessions = SceneSessions(session, scene, self._dispatcher, self._start, self._key, tokens)
        self._sessions.append(sessions)
        self._declared += sessions.declared
        streams = ResidencyStreams(session, scene, self._dispatcher, self._start, self._key, tokens.turn)
        self._declared += streams.declared
        self._start(f"{scene}-watch", _watch, watch.handler, tokens, lane, sessions, streams)
        lane.start()
        return lane

    def _declare_scenes(self, session: zenoh.Session) -> None:
        """Answer queries for the served scenes."""
        queryable = session.declare_queryable(
            key_expressions.scenes_key(), zenoh.handlers.FifoChannel(_CHANNEL), complete=True
        )
        self._declared.append(queryable)

        def take(queries: Any) -> None:
            for query in queries:
                try:
                    with query:
                        # Reply under the exact key: a wildcard that matches is not the server's
                        # key.
                        sealer = sealer_of(query, self._key, key_expressions.scenes_key(), b"")
                        send_reply(
                            query,
                            key_expressions.scenes_key(),
                            self._dispatcher.scenes(encoding_of(query)),
                            sealer,
                        )
                except Exception:  # affects this query only
                    log.exception("a query for the scenes failed")

        self._start("scenes", take, queryable.handler)

    def _start(self, name: str, run: Callable[..., None], *arguments: Any) -> None:
        """Start a thread that `__exit__` waits for."""
        thread = start_thread(name, run, *arguments)
        with self._lock:
            self._threads = [other for other in self._threads if other.is_alive()] + [thread]


def _watch(
    samples: Any, tokens: LivelinessTokens, lane: Lane, sessions: SceneSessions, streams: ResidencyStreams
) -> None:
    """Notify lane, sessions and streams of a scene of clients that connect or leave. Runs in a thread."""
    for sample in samples:
        try:
            client = key_expressions.parse_client_token(str(sample.key_expr))
        except BadRequestError as error:
            log.debug("a token of no client: %s", error)
            continue
        try:
            if sample.kind == zenoh.SampleKind.DELETE:
                tokens.gone(client)
                sessions.client_gone(client)
                streams.client_gone(client)
                lane.client_gone(client)
            else:
                tokens.here(client)
                lane.client_here(client)
        except Exception:  # affects this client only
            log.exception("client %s", client)
