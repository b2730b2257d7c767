"""Bytes in, bytes out over zenoh: the server's only user of it. What the bytes mean is the service's matter.

zenoh hands queries to a bounded channel; our own threads take them from there, since nothing may block in
one of its callbacks. Requests of one client are answered one at a time and in order, those of several
clients side by side, so that a client that does not take its replies stalls no other. An answer in parts is sent by a
thread of its own, beside all others.
"""

import json
import logging
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from types import TracebackType
from typing import Any, NamedTuple, Protocol, Self

import zenoh

from ..schemas import keys
from ..schemas.errors import BadRequestError, SolidcloudError
from ..schemas.messages import JSON, MAX_MESSAGE_BYTES, MSGPACK
from .config import ServerConfig
from .fair_queues import FairQueues, Offer
from .served import Answer
from .session_transport import Sessions, declare_sessions

log = logging.getLogger(__name__)

# Queries that zenoh may hand over before a thread takes them; a full channel holds up zenoh's receiver, which
# is what bounds memory in a storm. The threads empty it at once, into `FairQueues` or with `busy`.
_CHANNEL = 1024
# How long a stop waits for threads whose work was given up: for a part of a path that is being computed.
_GIVE_UP_SECONDS = 2.0

_ENCODINGS = {name: zenoh.Encoding(name) for name in (MSGPACK, JSON)}


class ServiceLike(Sessions, Protocol):
    """What a transport carries questions to. No method raises: an error is an answer too."""

    def scenes(self, encoding: str | None) -> Answer: ...
    def answer(self, key: str, payload: bytes, encoding: str | None) -> Answer | Iterator[Answer]: ...
    def busy(self, encoding: str | None) -> Answer: ...
    def client_gone(self, scene: str, client: str) -> None: ...


def session_config(*, listen: str | None = None, connect: str | None = None) -> zenoh.Config:
    """The configuration of a session, server's or client's: one endpoint, and nothing found by itself."""
    settings: dict[str, Any] = {
        # A peer opens although nobody is there yet, and goes on trying; a zenoh "client" fails instead.
        "mode": "peer",
        "listen/endpoints": [listen] if listen else [],
        "connect/endpoints": [connect] if connect else [],
        # By default 1 s, growing to 4 s: an outage would last that much longer than the server is away.
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
        # How long opening waits for the connection [ms], also now and then where it is there at once: 500.
        "scouting/delay": 200,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # A killed process would leave 16 MiB behind in /dev/shm.
        "transport/shared_memory/enabled": False,
        # A longer message is dropped unread, and its sender's query expires; by default 1 GiB is taken in.
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        # How long a reply waits for a client that takes none before its link is closed [µs]; by default 5 s.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 200_000,
        # By default 100 connections that never say a word keep new ones out for 10 s.
        "transport/unicast/accept_timeout": 1000,
        "transport/unicast/accept_pending": 1000,
    }
    if listen:
        # Whoever is connected could else declare our keys, and a zenoh "client" would be routed to it.
        settings["access_control"] = {
            "enabled": True,
            "default_permission": "allow",
            "rules": [
                {
                    "id": "nobody-else-answers",
                    "messages": ["declare_queryable", "reply"],
                    "flows": ["ingress"],
                    "permission": "deny",
                    "key_exprs": [f"{keys.ROOT}/**"],
                },
                {
                    "id": "nobody-else-publishes-states",
                    "messages": ["put", "delete"],
                    "flows": ["ingress"],
                    "permission": "deny",
                    "key_exprs": [f"{keys.ROOT}/{what}/**" for what in ("state", "refused")],
                },
            ],
            "subjects": [{"id": "everybody"}],
            "policies": [
                {
                    "rules": ["nobody-else-answers", "nobody-else-publishes-states"],
                    "subjects": ["everybody"],
                }
            ],
        }
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config


class Transport:
    """Carries questions to a service and its answers back, from `__enter__` until `__exit__`.

    SolidcloudError on entry when the endpoint cannot be listened on. Leaving it stops accepting, answers
    what was accepted (up to `config.stop_seconds`), gives up the rest, then closes.
    """

    def __init__(self, scenes: Sequence[str], service: ServiceLike, config: ServerConfig) -> None:
        self._scenes, self._service, self._config = tuple(scenes), service, config
        self._threads: list[threading.Thread] = []
        self._lock = threading.Lock()
        self._declared: list[Any] = []
        self._given_up = threading.Event()

    def __enter__(self) -> Self:
        with ExitStack() as stack:
            session = stack.enter_context(self._open())
            for scene in self._scenes:
                self._declare_scene(session, scene)
            self._declare_scenes(session)
            # Last: whoever sees the token may ask at once.
            for scene in self._scenes:
                key = keys.server_alive_key(scene, str(session.zid()))
                self._declared.append(session.liveliness().declare_token(key))
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._stack:
            # The tokens first. An undeclared queryable's channel still hands out what it holds, then ends.
            for declared in reversed(self._declared):
                declared.undeclare()
            if not self._wait(self._config.stop_seconds):
                log.warning("not all is answered after %g s: the rest is given up", self._config.stop_seconds)
                self._given_up.set()
                self._wait(_GIVE_UP_SECONDS)
        # Closing the session ends what waits for a client that takes nothing. A thread that is still at work when the
        # interpreter ends, inside zenoh, would abort the process.
        if not self._wait(_GIVE_UP_SECONDS):
            log.error("stopped with threads at work")

    def _wait(self, seconds: float) -> bool:
        """Wait for all threads, for so long at most; whether they have ended."""
        deadline = time.monotonic() + seconds
        # One may have started another, for a path, before it ended.
        while alive := [thread for thread in list(self._threads) if thread.is_alive()]:
            left = deadline - time.monotonic()
            if left <= 0:
                return False
            alive[0].join(left)
        return True

    def _open(self) -> zenoh.Session:
        """A session that listens; SolidcloudError when it cannot."""
        try:
            return zenoh.open(session_config(listen=self._config.listen))
        except zenoh.ZError as error:
            raise SolidcloudError(
                f"cannot listen on {self._config.listen}: {error}: is another server there? try another port"
            ) from None

    def _declare_scene(self, session: zenoh.Session, scene: str) -> None:
        """Answer the questions about one scene, and watch for clients that go."""
        config = self._config
        queues = FairQueues(config.workers, config.max_in_flight, config.max_in_flight_bytes)
        lane = _Lane(self._service, scene, queues, self._start, config.max_paths, self._given_up)
        watch = session.liveliness().declare_subscriber(
            keys.clients_alive_key(scene), zenoh.handlers.FifoChannel(_CHANNEL)
        )
        self._declared.append(watch)
        self._start(f"{scene}-watch", lane.watch, watch.handler)
        queryable = session.declare_queryable(
            keys.questions_key(scene), zenoh.handlers.FifoChannel(_CHANNEL), complete=True
        )
        self._declared.append(queryable)
        self._declared += declare_sessions(session, scene, self._service, self._start)
        for number in range(config.workers):
            self._start(f"{scene}-{number}", lane.take, queryable.handler)

    def _declare_scenes(self, session: zenoh.Session) -> None:
        """Answer which scenes are served."""
        queryable = session.declare_queryable(
            keys.scenes_key(), zenoh.handlers.FifoChannel(_CHANNEL), complete=True
        )
        self._declared.append(queryable)

        def take(queries: Any) -> None:
            for query in queries:
                with query:
                    _reply(query, keys.scenes_key(), self._service.scenes(_encoding(query)))

        self._start("scenes", take, queryable.handler)

    def _start(self, name: str, run: Callable[..., None], *arguments: Any) -> None:
        """A thread that is waited for at the end."""
        thread = threading.Thread(target=run, args=arguments, name=f"solidcloud-{name}", daemon=True)
        thread.start()
        with self._lock:
            self._threads = [other for other in self._threads if other.is_alive()] + [thread]


class _Gone(NamedTuple):
    """Takes a request's place in a client's queue: the client went, after all it had asked before."""

    client: str


class _Lane:
    """The questions about one scene, on their way from the channel to the service."""

    def __init__(
        self,
        service: ServiceLike,
        scene: str,
        queues: FairQueues,
        start: Callable[..., None],
        max_paths: int,
        given_up: threading.Event,
    ) -> None:
        self._service, self._scene, self._queues = service, scene, queues
        self._start, self._max_paths = start, max_paths
        self._given_up = given_up  # set: nothing more is answered
        self._streaming: set[_Request] = set()  # whose answers are on their way in parts

    def take(self, queries: Any) -> None:
        """One thread's work: take queries, answer them or leave them to the thread that is at work."""
        for query in queries:
            try:
                self._take(query)
            except Exception:  # of this query alone: the thread goes on with the next
                log.exception("a query of scene %s", self._scene)

    def _take(self, query: zenoh.Query) -> None:
        """Answer a query, or leave it to a thread that is at work."""
        request = _Request(query)
        offer = self._queues.offer(request.client, request, len(request.payload))
        if offer is Offer.RUN:
            self._run(request.client, request)
        elif offer is Offer.FULL:
            with query:
                _reply(query, request.key_expr, self._service.busy(_encoding(query)))

    def watch(self, samples: Any) -> None:
        """One thread's work: have the avatars of clients that went dropped."""
        for sample in samples:
            if sample.kind != zenoh.SampleKind.DELETE:
                continue
            client = str(sample.key_expr).rpartition("/")[2]
            # Nobody takes the rest of its paths.
            self._streaming.difference_update([r for r in list(self._streaming) if r.client == client])
            if self._queues.offer(client, _Gone(client), 0, always=True) is Offer.RUN:
                self._run(client, _Gone(client))

    def _run(self, client: str, request: Any) -> None:
        """Carry out one request, and then what waits, until nothing does."""
        following: tuple[str, Any] | None = (client, request)
        while following is not None:
            client, request = following
            parts = None
            try:
                if isinstance(request, _Gone):
                    self._service.client_gone(self._scene, request.client)
                else:
                    parts = self._answer(request)
            except Exception:
                log.exception("request of client %s of scene %s", client, self._scene)
            finally:
                if parts is None:
                    following = self._queues.finished(client)
                else:
                    size, following = self._queues.detach(client)
                    self._start(f"{self._scene}-parts", self._stream, request, parts, size)

    def _answer(self, request: "_Request") -> Iterator[Answer] | None:
        """Have one query answered. What comes in parts is returned, to be sent by a thread of its own."""
        if self._given_up.is_set():
            with request.query:
                return None
        answer = self._service.answer(request.key, request.payload, _encoding(request.query))
        if not isinstance(answer, Answer):
            # One client may take half of the room, so that there is always some for another.
            own = sum(other.client == request.client for other in list(self._streaming))
            if len(self._streaming) < self._max_paths and own < max(1, self._max_paths // 2):
                self._streaming.add(request)
                return answer
            answer = self._service.busy(_encoding(request.query))
        # Leaving `with query` tells the client that no more will come.
        with request.query as query:
            _reply(query, request.key_expr, answer)
        return None

    def _stream(self, request: "_Request", answers: Iterator[Answer], size: int) -> None:
        """Send an answer's parts. A thread's work."""
        try:
            with request.query as query:
                for answer in answers:
                    left = self._given_up.is_set() or request not in self._streaming
                    if left or not _reply(query, request.key_expr, answer):
                        break
        except Exception:
            log.exception("parts for client %s of scene %s", request.client, self._scene)
        finally:
            self._streaming.discard(request)
            self._queues.release(size)


class _Request:
    """A query on its way, and what was read of it: each property of a query is a copy that costs."""

    __slots__ = ("client", "key", "key_expr", "payload", "query")

    def __init__(self, query: zenoh.Query) -> None:
        self.query = query
        self.key_expr = query.key_expr
        self.key = str(self.key_expr)
        try:
            self.client = keys.parse_question(self.key).client  # whose queue it waits in
        except BadRequestError:
            self.client = ""  # nobody's: the service will refuse it
        payload = query.payload
        self.payload = b"" if payload is None else payload.to_bytes()


def _encoding(query: zenoh.Query) -> str | None:
    """The encoding a query states, if any."""
    return None if query.encoding is None else str(query.encoding)


def _reply(query: zenoh.Query, key: Any, answer: Answer) -> bool:
    """Send one answer; False where that fails: the client is gone, or its link is. Logged, nothing else to do."""
    try:
        if answer.ok:
            query.reply(key, answer.payload, encoding=_ENCODINGS[answer.encoding])
        else:
            query.reply_err(answer.payload, encoding=_ENCODINGS[answer.encoding])
    except zenoh.ZError as error:
        log.warning("reply to %s: %s", query.key_expr, error)
        return False
    return True
