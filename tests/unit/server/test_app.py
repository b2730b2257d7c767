"""The service between bytes and scenes, without zenoh."""

import sys
from pathlib import Path

import numpy as np
import pytest
from solidcloud.schemas.answers import CollideAnswers
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.messages import (
    JSON,
    MSGPACK,
    AddAvatarRequest,
    AvatarInfo,
    CollideRequest,
    ErrorReply,
    SceneInfo,
    ScenesAnswer,
    decode_answer,
    encode,
)
from solidcloud.server.app import Service
from solidcloud.server.config import ServerConfig

sys.path.insert(0, str(Path(__file__).parents[2] / "end_to_end"))
from fake_server import FloorScene, floor_verdicts

POINTS = np.array([[0.0, 0.0, 0.5], [0.0, 0.25, 1.0]])


def key(operation, scene="floor", client="c"):
    return f"solidcloud/1/scene/{scene}/{client}/{operation}"


@pytest.fixture
def scene():
    return FloorScene()


@pytest.fixture
def service(scene):
    return Service([scene], ServerConfig(max_poses=5, max_avatar_points=4, max_in_flight=7))


def ask(service, operation, request, encoding=MSGPACK, **where):
    payload = encode(request, encoding) if request is not None else b""
    return service.answer(key(operation, **where), payload, encoding)


def error(answer, encoding=MSGPACK):
    assert not answer.ok and answer.encoding == encoding
    return decode_answer(ErrorReply, answer.payload, encoding)


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_every_operation_answers_in_both_encodings(service, encoding):
    answer = ask(service, "add_avatar", AddAvatarRequest("al", POINTS, 0.25), encoding)
    assert decode_answer(AvatarInfo, answer.payload, encoding) == AvatarInfo("al", 2, 0.25, 1.0)
    poses = np.tile(np.eye(4), (3, 1, 1))
    poses[:, 2, 3] = [-0.25, -0.125, 0.0]
    answer = ask(service, "collide", CollideRequest("al", poses, 0.125), encoding)
    assert answer.ok and answer.encoding == encoding
    got = decode_answer(CollideAnswers, answer.payload, encoding)
    assert got.verdict.tolist() == floor_verdicts(POINTS, 0.25, poses, 0.125).tolist() == [1, 1, 0]
    info = decode_answer(SceneInfo, ask(service, "info", None, encoding).payload, encoding)
    assert (info.scene, info.points, info.sources[0].skipped) == ("floor", 4, {"nan": 1})
    scenes = decode_answer(ScenesAnswer, service.scenes(encoding).payload, encoding)
    assert scenes == ScenesAnswer(["floor"], 1, 1)


def test_without_a_stated_encoding_it_is_messagepack(service):
    answer = service.answer(key("info"), b"", None)
    assert decode_answer(SceneInfo, answer.payload).scene == "floor"


def test_an_unknown_encoding_is_bad_request(service):
    assert error(service.answer(key("info"), b"", "text/plain")).code == "bad_request"
    assert error(service.scenes("text/plain")).code == "bad_request"


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_refusals_come_as_codes_in_the_encoding_of_the_question(service, encoding):
    ask(service, "add_avatar", AddAvatarRequest("al", POINTS))
    ask(service, "add_avatar", AddAvatarRequest("crash", POINTS))
    pose = np.eye(4)[None]
    sheared = pose.copy()
    sheared[0, 3, 0] = 1.0
    cases = {
        "unknown_avatar": ("collide", CollideRequest("bo", pose)),
        "bad_transform": ("collide", CollideRequest("al", sheared)),
        "bad_request": ("add_avatar", AddAvatarRequest("al", POINTS + 1)),
        "internal": ("collide", CollideRequest("crash", pose)),
    }
    for code, (operation, request) in cases.items():
        assert error(ask(service, operation, request, encoding), encoding).code == code


def test_over_the_caps_is_too_large(service):
    assert error(ask(service, "collide", CollideRequest("al", np.zeros((6, 4, 4))))).code == "too_large"
    assert error(ask(service, "add_avatar", AddAvatarRequest("al", np.zeros((5, 3))))).code == "too_large"


def test_an_internal_error_tells_no_more_than_its_kind(service, caplog):
    ask(service, "add_avatar", AddAvatarRequest("crash", POINTS))
    reply = error(ask(service, "collide", CollideRequest("crash", np.eye(4)[None])))
    assert "RuntimeError" in reply.message and "secret" not in reply.message
    assert "secret" in caplog.text, "the log has the traceback"


def test_an_unknown_scene_names_those_served(service):
    reply = error(ask(service, "info", None, scene="attic"))
    assert reply.code == "unknown_scene" and "floor" in reply.message and "attic" in reply.message


@pytest.mark.parametrize("path", ["solidcloud/**", "solidcloud/1/scene/floor/*/info", key("effects"), ""])
def test_keys_that_are_no_question_are_bad_request(service, path):
    assert error(service.answer(path, b"", MSGPACK)).code == "bad_request"


def test_info_takes_no_payload(service):
    assert error(service.answer(key("info"), b"x", MSGPACK)).code == "bad_request"


def test_avatars_are_their_clients(service, scene):
    ask(service, "add_avatar", AddAvatarRequest("al", POINTS), client="one")
    pose = CollideRequest("al", np.eye(4)[None])
    assert ask(service, "collide", pose, client="one").ok
    assert error(ask(service, "collide", pose, client="two")).code == "unknown_avatar"
    service.client_gone("floor", "one")
    assert error(ask(service, "collide", pose, client="one")).code == "unknown_avatar"


def test_warming_warms_every_scene(service, scene):
    service.warm()
    assert scene.warmed == 1 and not scene.avatars


def test_busy_says_how_many(service):
    assert error(service.busy(JSON), JSON).code == "busy"
    assert "7" in error(service.busy(None)).message


def test_two_scenes_of_one_name_are_refused():
    with pytest.raises(BadRequestError, match="a name of its own"):
        Service([FloorScene(), FloorScene()], ServerConfig())


def test_a_scene_whose_name_no_key_can_hold_is_refused():
    with pytest.raises(BadRequestError, match="expected 1 to 64"):
        Service([FloorScene("a/b")], ServerConfig())
