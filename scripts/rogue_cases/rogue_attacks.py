"""Attacks of a rogue on one victim: each tool under each width of key expression, and the outcome.

The victim is a `Client` of the tests' generated floor, with a session. A rogue is a plain zenoh
session at the same server. An attempt succeeds if the victim receives forged data or loses
something, or if the rogue receives the victim's data.
"""

import json
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import msgspec
import numpy as np
import zenoh
from solidcloud.schemas.errors import SolidcloudError
from solidcloud.schemas.wire.answers import (
    CollideAnswers,
    CollidePart,
    DistanceAnswers,
    RaycastAnswers,
    SweepAnswers,
    Verdict,
    WithinAnswers,
)
from solidcloud.schemas.wire.encoding import decode_request, encode
from solidcloud.schemas.wire.motion_messages import State, Wish
from solidcloud.schemas.wire.question_table import make_unknown
from solidcloud.schemas.wire.requests import CollideRequest
from solidcloud.schemas.wire.scene_messages import AvatarInfo, ErrorReply, ScenesAnswer
from solidcloud.server.client import Client
from solidcloud.server.zenoh_client.client_session import ClientSession
from solidcloud.server.zenoh_common.zenoh_settings import session_config

MODES = ("client", "peer", "router")
AVATAR = "al"
POINTS = np.array([[0.0, 0.0, 0.5], [0.25, 0.0, 1.0], [0.0, 0.25, 1.5]])
MSGPACK = "application/msgpack"
# Time limits [s]: for a state on a busy machine, and for a query that nothing lets through.
DEADLINE, NO_REPLY = 20.0, 0.02


def widths(scene: str, client: str) -> list[str]:
    """Return key expressions that match the victim's keys, from wide to exact, and some neighbours."""
    return [
        "**",
        "solidcloud/**",
        "solidcloud/1/**",
        "*/1/scene/**",
        f"solidcloud/*/scene/{scene}/*/*",
        f"solidcloud/1/*/{scene}/**",
        f"solidcloud/1/scene/{scene}/{client}/**",
        f"solidcloud/1/stat$*/{scene}/{client}/{AVATAR}",
        f"solidcloud/1/*/{scene}/*/{AVATAR}",
        f"solidcloud/1/state/{scene}/*/*",
        f"solidcloud/1/wish/{scene}/*/*",
        f"solidcloud/1/residency/{scene}/*",
        f"solidcloud/1/client/{scene}/*",
    ]


class Victim(NamedTuple):
    """Client of the floor with a session on it, and its id."""

    client: Client
    session: ClientSession
    id: str


class Rogue:
    """Zenoh session of a rogue; a context manager."""

    def __init__(self, endpoint: str, mode: str) -> None:
        config = session_config(connect=endpoint)
        config.insert_json5("mode", json.dumps(mode))
        self.session = zenoh.open(config)

    def __enter__(self) -> "Rogue":
        return self

    def __exit__(self, *_: object) -> None:
        self.session.close()  # type: ignore[no-untyped-call]

    def settle(self) -> None:
        """Wait until the server has processed everything declared and sent.

        It then answers a later query on this link.
        """
        assert list(self.session.get("solidcloud/1/scenes", timeout=DEADLINE)), "the server is there"


Tool = Callable[[Rogue, str, Victim], list[str]]


def attempt(tool: str, rogue: Rogue, width: str, victim: Victim) -> list[str]:
    """Try a tool under one width; return its achievements in words."""
    try:
        return TOOLS[tool](rogue, width, victim)
    except zenoh.ZError:
        return []  # zenoh itself refuses such a key


def pose_at(x: float, z: float) -> Any:
    """Return a pose (4, 4) without rotation."""
    pose = np.eye(4)
    pose[0, 3], pose[2, 3] = x, z
    return pose


def _queryable(rogue: Rogue, width: str, victim: Victim) -> list[str]:
    heard: list[str] = []

    def lie(query: zenoh.Query) -> None:
        with query:
            heard.append(str(query.key_expr))
            if query.payload is not None:
                query.reply(query.key_expr, zeros(query), encoding=MSGPACK)

    with rogue.session.declare_queryable(width, lie, complete=True):
        rogue.settle()
        found = _asked(victim)
        state = _walked(victim, 0.5)
    return found + state + [f"asked {key}" for key in heard if victim.id in key]


def zeros(query: zenoh.Query) -> bytes:
    """Return a forged answer: `clear` for everything to a request, a far state to anything else."""
    operation = str(query.key_expr).rpartition("/")[2]
    try:
        asked = msgspec.msgpack.decode(query.payload.to_bytes())
        rows = next(len(asked[name]) // size for name, size in _ROW_BYTES.items() if name in asked)
    except (msgspec.DecodeError, StopIteration, TypeError):
        rows = 0
    if operation == "path":
        none = np.zeros(rows, np.uint32)
        return encode(CollidePart(none.astype(np.uint8), none > 0, none, none, none, first=0, total=rows))
    if operation not in _ANSWERS:
        return encode(State(pose=pose_at(9.0, 9.0)[None], seq=10**9, time=0.0, frame=1))
    answers = make_unknown(_ANSWERS[operation], rows, bounded=False)
    return encode(msgspec.structs.replace(answers, verdict=np.zeros(rows, np.uint8), engine_seconds=1e-3))


_ROW_BYTES = {"poses": 128, "pose_from": 128, "origins": 24, "points": 24}
_ANSWERS: dict[str, Any] = {
    "collide": CollideAnswers, "distance": DistanceAnswers, "sweep": SweepAnswers, "raycast": RaycastAnswers,
    "within": WithinAnswers,
}  # fmt: skip


def _asked(victim: Victim) -> list[str]:
    """Return the faults in the victim's answers about poses in the floor."""
    poses = np.tile(pose_at(0.0, -1.0), (3, 1, 1))
    verdicts = [victim.client.collide(AVATAR, poses).verdict]
    verdicts += [part.verdict for part in victim.client.path(AVATAR, poses)]
    if (np.concatenate(verdicts) == Verdict.CONTACT).all():
        return []
    return [f"verdicts {[verdict.tolist() for verdict in verdicts]}"]


def _walked(victim: Victim, z: float) -> list[str]:
    """Return the faults in the victim's position after a motion."""
    try:
        for _ in range(3):
            state = victim.session.wait(victim.session.wish(pose_at(0.0, z)), DEADLINE)
            if state.pose[0, 0, 3] != 0.0 or state.pose[0, 2, 3] != z or state.seq > 10**8:
                return [f"at {state.pose[0, :3, 3].tolist()}, number {state.seq}"]
        latest = victim.session.latest()
        return [] if latest is not None and latest.frame == state.frame else ["another state than the last"]
    except SolidcloudError as error:
        return [f"{type(error).__name__}: {error}"]


def _put(rogue: Rogue, width: str, victim: Victim) -> list[str]:
    far = pose_at(9.0, 9.0)[None]
    for message in (
        State(pose=far, seq=10**9, time=0.0, frame=1),
        ErrorReply("internal", "a lie"),
        Wish(seq=10**9, time=1.0, pose=far),
    ):
        rogue.session.put(width, encode(message), encoding=MSGPACK)
    rogue.session.delete(width)
    rogue.settle()
    return _walked(victim, 0.75)


def _token(rogue: Rogue, width: str, victim: Victim) -> list[str]:
    rogue.session.liveliness().declare_token(width).undeclare()
    rogue.settle()
    time.sleep(0.005)  # the server receives tokens on a separate channel
    request = encode(CollideRequest(AVATAR, pose_at(0.0, -1.0)[None]))
    try:
        victim.client._connection.ask("collide", request, [AVATAR])
    except SolidcloudError as error:
        _asked(victim)  # adds the avatar again
        return [f"{type(error).__name__}: {error}"]
    return []


def _subscriber(rogue: Rogue, width: str, victim: Victim) -> list[str]:
    heard: list[Any] = []
    with rogue.session.declare_subscriber(width, heard.append):
        rogue.settle()
        wrong = _walked(victim, 0.25)
        rogue.settle()
    return wrong + [f"heard {sample.key_expr}" for sample in heard]


def _liveliness(rogue: Rogue, width: str, victim: Victim) -> list[str]:
    heard: list[Any] = []
    liveliness = rogue.session.liveliness()
    with liveliness.declare_subscriber(width, heard.append, history=True):
        rogue.settle()
        heard += [reply.ok for reply in liveliness.get(width, timeout=NO_REPLY) if reply.ok is not None]
    return [f"heard of {sample.key_expr}" for sample in heard if victim.id in str(sample.key_expr)]


def _query(rogue: Rogue, width: str, victim: Victim) -> list[str]:
    replies = rogue.session.get(
        width, target=zenoh.QueryTarget.ALL, consolidation=zenoh.ConsolidationMode.NONE, timeout=NO_REPLY
    )
    said = [(str(r.ok.key_expr), r.ok.payload.to_bytes()) for r in replies if r.ok is not None]
    return [f"told {key}" for key, payload in said if victim.id in key or victim.id.encode() in payload]


TOOLS: dict[str, Tool] = {
    "queryable": _queryable,
    "put": _put,
    "token": _token,
    "subscriber": _subscriber,
    "liveliness": _liveliness,
    "query": _query,
}


class Impostor:
    """Program that listens at a server's address and answers `clear` under the right keys.

    A context manager.
    seal: makes the attachment of a reply from the query and the payload; by default there is none.
    """

    def __init__(
        self, endpoint: str, seal: Callable[[zenoh.Query, bytes], bytes | None] | None = None
    ) -> None:
        """Begin to listen."""
        config = session_config()
        config.insert_json5("listen/endpoints", json.dumps([endpoint]))
        self.asked: list[str] = []
        self.keys: set[str] = set()
        self._seal = seal or (lambda query, payload: None)
        self._states: list[zenoh.Query] = []
        self._session = zenoh.open(config)
        for key in ("solidcloud/1/scenes", "solidcloud/1/scene/*/*/*", "solidcloud/1/state/*/*/*"):
            self._session.declare_queryable(key, self._answer, complete=True)
        self._session.declare_subscriber("solidcloud/1/wish/*/*/*", self._wished)

    def __enter__(self) -> "Impostor":
        return self

    def __exit__(self, *_: object) -> None:
        self._states.clear()
        self._session.close()  # type: ignore[no-untyped-call]

    def _answer(self, query: zenoh.Query) -> None:
        key = str(query.key_expr)
        self.keys.add(key)
        self.asked.append(key.rpartition("/")[2] if "/scene/" in key else key.split("/")[2])
        if "/state/" in key:
            self._states.append(query)
            return
        with query:
            if key.endswith("/scenes"):
                self._reply(query, encode(ScenesAnswer(["floor"], 1, 1)))
            elif key.endswith("/add_avatar"):
                self._reply(query, encode(AvatarInfo(AVATAR, 3, 0.125, 1.0)))
            elif query.payload is not None:
                self._reply(query, zeros(query))

    def _wished(self, sample: zenoh.Sample) -> None:
        if sample.kind != zenoh.SampleKind.PUT:
            return
        wish = decode_request(Wish, sample.payload.to_bytes())
        state = State(pose=pose_at(9.0, 9.0)[None], seq=wish.seq, time=wish.time, frame=1)
        for query in list(self._states):
            self._reply(query, encode(state))

    def _reply(self, query: zenoh.Query, payload: bytes) -> None:
        query.reply(query.key_expr, payload, encoding=MSGPACK, attachment=self._seal(query, payload))
