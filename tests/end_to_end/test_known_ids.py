"""Test that a rogue who knows a client's id cannot replace its avatars on a restarted server."""

import json
import time
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import zenoh
from floor import DEADLINE, POINTS, eventually, heights
from rogue_cases.rogue_attacks import Impostor
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.errors import SolidcloudError
from solidcloud.schemas.wire import key_expressions
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.encoding import MSGPACK, encode
from solidcloud.schemas.wire.motion_messages import Wish
from solidcloud.schemas.wire.requests import AddAvatarRequest
from solidcloud.server.client import Client
from solidcloud.server.scene import Scene
from solidcloud.server.zenoh_common.zenoh_settings import session_config
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig
from walkers import pose_at

POSES = heights([-1.0, -0.5])
CONTACTS = [Verdict.CONTACT] * 2
# A false avatar "al": shifted high above the floor.
LIE = (POINTS + np.array([0.0, 0.0, 50.0]), 0.125)


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build a floor of 4 by 4 m at z = 0."""
    folder = tmp_path_factory.mktemp("floor")
    x, y = np.meshgrid(np.arange(-2, 2, 0.05), np.arange(-2, 2, 0.05))
    np.savetxt(folder / "floor.xyz", np.column_stack([x.ravel(), y.ravel(), 0 * x.ravel()]), fmt="%.4f")
    build_archive([folder / "floor.xyz"], folder / "floor", BuildConfig(jobs=1))
    return folder / "floor"


@contextmanager
def served(archive, endpoint):
    with (
        Scene.open(archive, "floor", budget_bytes=64 << 20) as scene,
        serving([scene], ServerConfig(listen=endpoint)),
    ):
        yield


@contextmanager
def known_by_a_rogue(archive, endpoint):
    """Yield a client with right answers, and its id.

    An impostor at its dead server's endpoint has heard the id.
    """
    with Client(endpoint, scene="floor", timeout=2.0) as client:
        client.add_avatar("al", POINTS, 0.125)
        with served(archive, endpoint):
            eventually(lambda: client.collide("al", POSES).verdict.tolist() == CONTACTS)
        with Impostor(endpoint) as impostor:
            eventually(lambda: client.collide("al", POSES) is not None and "collide" in impostor.asked)
            heard = {key.split("/")[4] for key in impostor.keys if "/scene/" in key}
        assert heard == {client._connection.client_id}
        yield client, heard.pop()


@contextmanager
def rogue_session(endpoint):
    config = session_config(connect=endpoint)
    config.insert_json5("mode", json.dumps("client"))
    with zenoh.open(config) as session:
        yield session


def add(session, client, points, radius, name="al"):
    """Add an avatar on behalf of a client."""
    key = key_expressions.query_key("floor", client, "add_avatar")
    payload = encode(AddAvatarRequest(name, points, radius))
    replies = list(session.get(key, payload=payload, encoding=MSGPACK, timeout=DEADLINE))
    assert replies and replies[0].ok is not None


def verdicts_of(client, kind):
    """Return the verdicts of one kind of query."""
    if kind == "path":
        return np.concatenate([part.verdict for part in client.path("al", POSES)]).tolist()
    return client.collide("al", POSES).verdict.tolist()


def verdicts_until_right(client, kind):
    """Repeat a query until the client is connected again and right; return all verdicts meanwhile."""
    heard = []

    def are_right():
        found = verdicts_of(client, kind)
        heard.extend(found)
        return found == CONTACTS or Verdict.CLEAR in found

    eventually(are_right)
    return heard


@pytest.mark.parametrize("kind", ["collide", "path"])
def test_answers_about_an_avatar_that_somebody_else_added_are_not_believed(archive, endpoint, kind):
    with (
        known_by_a_rogue(archive, endpoint) as (client, known),
        served(archive, endpoint),
        rogue_session(endpoint) as rogue,
    ):
        add(rogue, known, *LIE)
        assert Verdict.CLEAR not in verdicts_until_right(client, kind)
        assert client._connection.client_id != known, "the id that somebody knows is not used any more"


def states_after(session, count, height):
    """Return the heights in a session's states after motion commands to a height, and names of errors."""
    found = []
    for _ in range(count):
        try:
            found.append(session.wait(session.wish(pose_at(0.0, height)), 0.5).pose[0, 2, 3])
        except SolidcloudError as error:
            found.append(type(error).__name__)
    return found


def test_a_session_does_not_walk_as_an_avatar_that_somebody_else_added(archive, endpoint):
    with (
        known_by_a_rogue(archive, endpoint) as (client, known),
        served(archive, endpoint),
        rogue_session(endpoint) as rogue,
    ):
        add(rogue, known, *LIE)
        user = key_expressions.User(known, "al")
        wish = Wish(seq=1, time=0.0, pose=pose_at(0.0, -3.0)[None])
        rogue.put(key_expressions.command_key("floor", user), encode(wish), encoding=MSGPACK)
        time.sleep(0.2)  # the false wish arrives first
        with client.session("al") as session:
            eventually(lambda: states_after(session, 1, 2.0) == [2.0])
            # The client's own avatar does not enter the floor; the false one would.
            for height in (1.0, -1.0):
                found = states_after(session, 20, height)
                assert not [each for each in found if not isinstance(each, str) and each < -0.2], found
            assert client._connection.client_id != known
