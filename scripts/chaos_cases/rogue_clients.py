"""Rogue clients, each a process of a few seconds: false answers, floods, heavy requests, invented ids.

They use zenoh directly, as a foreign client would.
"""

import itertools
import os
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import numpy as np
import zenoh
from rogue_cases.rogue_attacks import widths, zeros
from solidcloud.schemas.archive.pose_arrays import make_poses
from solidcloud.schemas.wire import key_expressions
from solidcloud.schemas.wire.encoding import MSGPACK, encode
from solidcloud.schemas.wire.requests import AddAvatarRequest, CollideRequest, ContactsRequest
from solidcloud.server.zenoh_common.zenoh_settings import session_config

from .fixtures import SCENE

ENCODING = zenoh.Encoding(MSGPACK)
# Keys that match the queries of all clients of the scene, or their states.
WIDE = widths(SCENE, "*")


def _open(endpoint: str, mode: str) -> zenoh.Session:
    """Open a session with the server, without access control."""
    config = session_config(connect=endpoint)
    config.insert_json5("mode", f'"{mode}"')
    return zenoh.open(config)


def _lie(query: Any) -> None:
    """Answer a query with zeros, which mean clear."""
    with query:
        if query.payload is not None:
            query.reply(query.key_expr, zeros(query), encoding=ENCODING)


def rogue(folder: Path, endpoint: str, seed: int, seconds: float) -> None:
    """Answer `clear` under wide keys, declare tokens of other clients, publish states and motion commands."""
    rng = np.random.default_rng(seed)
    mode = str(rng.choice(["client", "peer"]))
    try:
        session = _open(endpoint, mode)
    except zenoh.ZError:
        return  # a client does not open while the server is away
    with session, ExitStack() as stack:

        def declare(what: Callable[..., Any], *arguments: Any, **options: Any) -> None:
            with suppress(zenoh.ZError):
                stack.enter_context(what(*arguments, **options))

        for key in rng.permutation(WIDE)[:6].tolist():
            declare(session.declare_queryable, key, _lie, complete=bool(rng.integers(2)))
            declare(session.liveliness().declare_token, key)
            declare(session.declare_subscriber, key, lambda _: None)
        declare(session.liveliness().declare_token, f"solidcloud/1/alive/{SCENE}/rogue")
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            for what in ("state", "wish"):
                for key in (f"solidcloud/1/{what}/{SCENE}/*/*", f"solidcloud/1/{what}/**"):
                    with suppress(zenoh.ZError):
                        session.put(key, os.urandom(64), encoding=ENCODING)
            time.sleep(0.05)


def flood(folder: Path, endpoint: str, seed: int, seconds: float) -> None:
    """Keep 1,000 queries of one client in flight."""
    client = f"flood{seed}"
    poses = make_poses(np.tile(np.eye(4), (20, 1, 1)))
    with (
        _open(endpoint, "peer") as session,
        session.liveliness().declare_token(key_expressions.client_token_key(SCENE, client)),
    ):
        add = encode(AddAvatarRequest("ball", np.zeros((1, 3)), 0.1))
        list(
            session.get(
                key_expressions.query_key(SCENE, client, "add_avatar"),
                payload=add,
                encoding=ENCODING,
                timeout=2.0,
            )
        )
        request = encode(CollideRequest(avatar="ball", poses=poses))
        free = threading.Semaphore(1000)
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            if free.acquire(timeout=0.1):
                handler = zenoh.handlers.Callback(lambda _: None, free.release)
                key = key_expressions.query_key(SCENE, client, "collide")
                session.get(key, handler, payload=request, encoding=ENCODING, timeout=5.0)


def heavy(folder: Path, endpoint: str, seed: int, seconds: float) -> None:
    """Request all contacts of 200,000 points at a margin of 3 m, under two ids; leave before the answer."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (200_000, 3))
    poses = make_poses(np.tile(np.eye(4), (2000, 1, 1)))
    with _open(endpoint, "peer") as session, ExitStack() as stack:
        for number in range(2):
            client = f"heavy{seed}-{number}"
            stack.enter_context(
                session.liveliness().declare_token(key_expressions.client_token_key(SCENE, client))
            )
            for op, request in (
                ("add_avatar", AddAvatarRequest("crowd", points, 0.01)),
                ("contacts", ContactsRequest(avatar="crowd", poses=poses, margin=3.0)),
            ):
                handler = zenoh.handlers.Callback(lambda _: None, lambda: None)
                key = key_expressions.query_key(SCENE, client, op)
                session.get(key, handler, payload=encode(request), encoding=ENCODING, timeout=5.0)
                time.sleep(1.0)
        time.sleep(seconds)


def invented(folder: Path, endpoint: str, seed: int, seconds: float) -> None:
    """Add avatars under one invented id after another, without a token."""
    rng = np.random.default_rng(seed)
    request = encode(AddAvatarRequest("body", rng.uniform(-1, 1, (2000, 3)), 0.01))
    with _open(endpoint, "peer") as session:
        end = time.monotonic() + seconds
        for number in itertools.count():
            if time.monotonic() > end:
                return
            key = key_expressions.query_key(SCENE, f"nobody-{seed}-{number}", "add_avatar")
            list(session.get(key, payload=request, encoding=ENCODING, timeout=1.0))


def usurper(folder: Path, endpoint: str, seed: int, seconds: float) -> None:
    """Listen at the server's endpoint while it is down, and answer `clear` to all clients."""
    config = session_config(listen=endpoint)
    config.insert_json5("access_control/enabled", "false")
    with zenoh.open(config) as session, session.declare_queryable("solidcloud/**", _lie, complete=True):
        time.sleep(seconds)


ROGUE_CLIENTS = {"rogue": rogue, "flood": flood, "heavy": heavy, "invented": invented}


def main(kind: str, folder: Path, endpoint: str, seed: int, seconds: float) -> None:
    """Run one kind of rogue client, or the usurper of a dead server's endpoint."""
    (ROGUE_CLIENTS | {"usurper": usurper})[kind](folder, endpoint, seed, seconds)
