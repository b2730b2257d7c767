"""Test a client and a server over zenoh on loopback: answers and refusals."""

import threading

import numpy as np
import pytest
import zenoh
from fake_server import FloorScene, floor_verdicts
from floor import DEADLINE, POINTS, eventually, heights
from solidcloud.schemas.errors import (
    BadRequestError,
    BadTransformError,
    InternalError,
    SolidcloudError,
    TooLargeError,
    UnknownAvatarError,
    UnknownSceneError,
)
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.encoding import JSON, MSGPACK, decode_answer, encode
from solidcloud.schemas.wire.requests import CollideRequest
from solidcloud.schemas.wire.scene_messages import AvatarInfo, ErrorReply, ScenesAnswer
from solidcloud.schemas.wire.warming_parts import PARTS
from solidcloud.server import client as client_module
from solidcloud.server.client import Client
from solidcloud.server.zenoh_common.zenoh_settings import session_config
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig


def test_client_answers_as_the_judge_does(client):
    rng = np.random.default_rng(2)
    poses = heights(rng.normal(-0.5, 0.3, 500))
    assert client.add_avatar("al", POINTS, 0.125) == AvatarInfo("al", 3, 0.125, 1.0)
    answers = client.collide("al", poses, margin=0.0625)
    expected = floor_verdicts(POINTS, 0.125, poses, 0.0625)
    assert {0, 1} == set(expected)
    assert np.array_equal(answers.verdict, expected)
    assert client.info().scene == "floor" and client.info().sources[0].path == "floor.las"


def test_long_lists_are_split_and_joined_in_order(client, monkeypatch):
    monkeypatch.setattr(client_module, "BATCH_POSES", 7)
    poses = heights(np.random.default_rng(3).normal(-0.5, 0.3, 40))
    poses[:, 0, 3] = np.arange(40) % 3
    client.add_avatar("al", POINTS, 0.125)
    answers = client.collide("al", poses)
    assert np.array_equal(answers.verdict, floor_verdicts(POINTS, 0.125, poses))
    assert np.array_equal(answers.outside, poses[:, 0, 3] > 1)
    assert (answers.hits, answers.engine_seconds, answers.resident) == (6, 6 * 0.25, 1)


def test_no_poses_no_answers(client):
    client.add_avatar("al", POINTS)
    assert len(client.collide("al", np.zeros((0, 4, 4)))) == 0
    with pytest.raises(UnknownAvatarError):
        client.collide("bo", np.zeros((0, 4, 4)))


def test_what_the_server_refuses_is_raised_here(client):
    client.add_avatar("al", POINTS)
    client.add_avatar("crash", POINTS)
    pose = np.eye(4)[None]
    with pytest.raises(UnknownAvatarError, match="bo"):
        client.collide("bo", pose)
    with pytest.raises(BadTransformError):
        client.collide("al", pose + 1)
    with pytest.raises(BadRequestError, match="poses"):
        client.collide("al", pose * np.nan)
    with pytest.raises(BadRequestError, match="margin"):
        client.collide("al", pose, margin=-1.0)
    with pytest.raises(BadRequestError, match="shape"):
        client.collide("al", np.eye(3))
    with pytest.raises(BadRequestError, match="other points"):
        client.add_avatar("al", POINTS + 1)
    with pytest.raises(InternalError, match="RuntimeError"):
        client.collide("crash", pose)
    assert client.collide("al", pose).verdict[0] == Verdict.CLEAR, "the server goes on answering"


def test_a_wrong_scene_name_is_an_error_that_names_those_served(scene, endpoint):
    with (
        serving([scene, FloorScene("attic")], ServerConfig(listen=endpoint)),
        pytest.raises(UnknownSceneError, match="served: attic, floor"),
        Client(endpoint, scene="hall"),
    ):
        pass


def test_avatars_that_can_be_none_are_refused_without_a_server(endpoint):
    with Client(endpoint, scene="floor") as client:
        for points in (POINTS * np.nan, POINTS[0], [["a", "b", "c"]]):
            with pytest.raises(BadRequestError):
                client.add_avatar("al", points)
        with pytest.raises(BadRequestError, match="radius"):
            client.add_avatar("al", POINTS, -1.0)
        with pytest.raises(BadRequestError, match="characters"):
            client.add_avatar("", POINTS)
        client.add_avatar("al", POINTS)
        with pytest.raises(BadRequestError, match="choose another name"):
            client.add_avatar("al", POINTS + 1)


def test_avatars_go_with_their_client(scene, endpoint):
    with serving([scene], ServerConfig(listen=endpoint)):
        with Client(endpoint, scene="floor") as one, Client(endpoint, scene="floor") as two:
            one.add_avatar("al", POINTS)
            two.add_avatar("al", POINTS + 1)
            assert len(scene.avatars) == 2
            one.close()
            eventually(lambda: len(scene.avatars) == 1)
            assert two.collide("al", np.eye(4)[None]).verdict[0] == Verdict.CLEAR
        eventually(lambda: not scene.avatars)


def test_a_server_that_forgot_an_avatar_is_given_it_again(client, scene):
    client.add_avatar("al", POINTS, 0.1)
    scene.avatars.clear()
    assert client.collide("al", heights([-1.0])).verdict.tolist() == [Verdict.CONTACT]


def test_one_slow_client_does_not_hold_up_others(client, scene, endpoint):
    with Client(endpoint, scene="floor", timeout=DEADLINE) as slow:
        slow.add_avatar("wait", POINTS)
        client.add_avatar("al", POINTS, 0.1)
        answers = []
        threads = [
            threading.Thread(target=lambda: answers.append(slow.collide("wait", np.eye(4)[None])))
            for _ in range(5)
        ]
        for thread in threads:
            thread.start()
        try:
            eventually(lambda: scene.at_work > 0)
            for _ in range(20):
                assert client.collide("al", heights([-1.0])).verdict.tolist() == [Verdict.CONTACT]
            assert not answers, "all five still wait, and only one of them is at work"
        finally:
            scene.gate.set()
        for thread in threads:
            thread.join(DEADLINE)
        assert len(answers) == 5


def test_what_is_too_much_is_busy_and_the_rest_is_answered(scene, endpoint):
    config = ServerConfig(listen=endpoint, max_in_flight=4)
    with serving([scene], config), zenoh.open(session_config(connect=endpoint)) as session:
        scene.avatars["c", "wait"] = (POINTS, 0.1)
        payload = encode(CollideRequest("wait", np.eye(4)[None]))
        key = "solidcloud/1/scene/floor/c/collide"
        asked = [session.get(key, payload=payload, timeout=DEADLINE) for _ in range(10)]
        replies = [next(iter(handler)) for handler in asked[4:]]
        scene.gate.set()
        replies += [next(iter(handler)) for handler in asked[:4]]
    errors = [decode_answer(ErrorReply, reply.err.payload.to_bytes()).code for reply in replies if reply.err]
    assert errors == ["busy"] * 6


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_plain_zenoh_is_enough_to_ask(scene, endpoint, encoding):
    with (
        serving([scene], ServerConfig(listen=endpoint)),
        zenoh.open(session_config(connect=endpoint)) as session,
    ):
        reply = next(iter(session.get("solidcloud/1/scenes", encoding=encoding)))
        assert str(reply.ok.encoding) == encoding
        assert decode_answer(ScenesAnswer, reply.ok.payload.to_bytes(), encoding).scenes == ["floor"]
        for key, code in {
            "solidcloud/1/scene/floor/c/effects": "bad_request",
            "solidcloud/1/scene/floor/*/info": "bad_request",
            "solidcloud/1/scene/floor/c/info": None,
        }.items():
            reply = next(iter(session.get(key, encoding=encoding)))
            if code is None:
                assert reply.ok is not None
            else:
                assert decode_answer(ErrorReply, reply.err.payload.to_bytes(), encoding).code == code
        assert not list(session.get("solidcloud/1/scene/attic/c/info")), "not served: an empty reply"
        assert scene.warmed == len(PARTS) and not scene.gone


def test_nobody_else_answers_for_the_server(client, endpoint):
    def lie(query):
        with query:
            query.reply(query.key_expr, b"all clear")

    client.add_avatar("al", POINTS, 0.1)
    config = session_config(connect=endpoint)
    config.insert_json5("mode", '"client"')
    with zenoh.open(config) as rogue, rogue.declare_queryable("solidcloud/1/scene/floor/**", lie):
        for _ in range(20):
            assert client.collide("al", heights([-1.0])).verdict.tolist() == [Verdict.CONTACT]


def test_an_avatar_over_the_cap_is_an_error_and_poses_over_it_are_asked_in_halves(client, monkeypatch):
    client.add_avatar("al", POINTS, 0.1)
    with pytest.raises(TooLargeError):
        client.add_avatar("huge", np.zeros((1_000_001, 3)))
    # The server refuses a request of this size; the client splits it in halves.
    monkeypatch.setattr(client_module, "BATCH_POSES", 10**6)
    verdict = client.collide("al", np.tile(np.eye(4), (100_001, 1, 1))).verdict
    assert len(verdict) == 100_001 and len(set(verdict.tolist())) == 1
    assert client.collide("al", heights([-1.0])).verdict.tolist() == [Verdict.CONTACT]


def test_a_taken_port_is_an_error_that_says_so(client, endpoint):
    with (
        pytest.raises(SolidcloudError, match="another server"),
        serving([FloorScene()], ServerConfig(listen=endpoint)),
    ):
        pass


def test_a_closed_client_says_so(client):
    client.close()
    client.close()
    with pytest.raises(BadRequestError, match="closed"):
        client.info()


def test_an_endpoint_that_is_none_is_bad_request():
    with pytest.raises(BadRequestError, match="endpoint"), Client("here", scene="floor"):
        pass
