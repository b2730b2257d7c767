"""Test that a rogue who knows a client's id cannot replace its avatars on a restarted server."""

import json
import time
from contextlib import contextmanager, suppress
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
# False avatars "al": a point far away, with another radius, and shifted high above the floor.
LIES = {
    "far": (np.full((1, 3), 1e6), 0.125),
    "radius": (POINTS, 1e-6),
    "high": (POINTS + np.array([0.0, 0.0, 50.0]), 0.125),
}


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
def known_by_a_rogue(archive, endpoint, radius=0.125):
    """Yield a client with right answers, and its id.

    An impostor at its dead server's endpoint has heard the id.
    """
    with Client(endpoint, scene="floor", timeout=2.0) as client:
        client.add_avatar("al", POINTS, radius)
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
    if kind == "objects":
        found = client.objects([("al", POSES[0]), ("al", POSES[1])])
        return found.verdict.tolist()
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


@pytest.mark.parametrize("lie", LIES)
@pytest.mark.parametrize("kind", ["collide", "objects", "path"])
def test_answers_about_an_avatar_that_somebody_else_added_are_not_believed(archive, endpoint, kind, lie):
    with (
        known_by_a_rogue(archive, endpoint) as (client, known),
        served(archive, endpoint),
        rogue_session(endpoint) as rogue,
    ):
        add(rogue, known, *LIES[lie])
        assert Verdict.CLEAR not in verdicts_until_right(client, kind)
        assert client._connection.client_id != known, "the id that somebody knows is not used any more"


def test_a_radius_that_the_server_makes_is_known_by_what_it_said(archive, endpoint):
    with (
        known_by_a_rogue(archive, endpoint, radius=None) as (client, known),
        served(archive, endpoint),
        rogue_session(endpoint) as rogue,
    ):
        add(rogue, known, *LIES["high"])
        assert Verdict.CLEAR not in verdicts_until_right(client, "collide")


def test_an_avatar_that_somebody_else_added_first_does_not_keep_the_own_one_out(archive, endpoint):
    """Test a false avatar added between `unknown_avatar` and the client's own `add_avatar`."""
    with (
        known_by_a_rogue(archive, endpoint) as (client, known),
        served(archive, endpoint),
        rogue_session(endpoint) as rogue,
    ):
        ask, added = client._connection.ask, []

        def asking(operation, request, names=()):
            if operation == "add_avatar" and not added:
                added.append(add(rogue, known, *LIES["high"]))
            return ask(operation, request, names)

        client._connection.ask = asking
        assert Verdict.CLEAR not in verdicts_until_right(client, "collide") and added


def states_after(session, count, height):
    """Return the heights in a session's states after motion commands to a height, and names of errors."""
    found = []
    for _ in range(count):
        try:
            found.append(session.wait(session.wish(pose_at(0.0, height)), 0.5).pose[0, 2, 3])
        except SolidcloudError as error:
            found.append(type(error).__name__)
    return found


@pytest.mark.parametrize("begun", ["before", "after"])
def test_a_session_does_not_walk_as_an_avatar_that_somebody_else_added(archive, endpoint, begun):
    with known_by_a_rogue(archive, endpoint) as (client, known):
        session = client.session("al")
        if begun == "before":
            session.__enter__()
        with served(archive, endpoint), rogue_session(endpoint) as rogue:
            add(rogue, known, *LIES["high"])
            user = key_expressions.User(known, "al")
            wish = Wish(seq=1, time=0.0, pose=pose_at(0.0, -3.0)[None])
            rogue.put(key_expressions.command_key("floor", user), encode(wish), encoding=MSGPACK)
            rogue_began = time.monotonic()
            eventually(lambda: time.monotonic() - rogue_began > 0.2)
            if begun == "after":
                session.__enter__()
            with session:
                eventually(lambda: states_after(session, 1, 2.0) == [2.0])
                # The client's own avatar does not enter the floor; the false one would.
                for height in (1.0, -1.0):
                    found = states_after(session, 20, height)
                    assert not [each for each in found if not isinstance(each, str) and each < -0.2], found
                assert client._connection.client_id != known


def test_a_session_goes_on_when_a_question_found_out(archive, endpoint):
    with (
        known_by_a_rogue(archive, endpoint) as (client, known),
        served(archive, endpoint),
        rogue_session(endpoint) as rogue,
        client.session("al") as session,
    ):
        eventually(lambda: states_after(session, 1, 2.0) == [2.0])
        # Take the avatar from the client, as the end of a token does, and replace it.
        token = rogue.liveliness().declare_token(key_expressions.client_token_key("floor", known))
        token.undeclare()
        eventually(lambda: list(rogue.get("solidcloud/1/scenes", timeout=DEADLINE)))
        time.sleep(0.1)
        with suppress(AssertionError):  # the client was first
            add(rogue, known, *LIES["high"])
        assert Verdict.CLEAR not in verdicts_until_right(client, "collide")
        eventually(lambda: states_after(session, 1, 1.5) == [1.5])
