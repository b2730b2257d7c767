"""The service between bytes and scenes, without zenoh."""

import sys
from pathlib import Path

import numpy as np
import pytest
from solidcloud.schemas.errors import BadRequestError, FormatError
from solidcloud.schemas.wire.answers import CollideAnswers, CollidePart
from solidcloud.schemas.wire.encoding import JSON, MSGPACK, decode_answer, encode
from solidcloud.schemas.wire.key_expressions import User
from solidcloud.schemas.wire.motion_messages import Moved, MoveRequest, Wish
from solidcloud.schemas.wire.path_messages import PathRequest
from solidcloud.schemas.wire.question_table import QUESTIONS, check_answers
from solidcloud.schemas.wire.requests import (
    AddAvatarRequest,
    CollideRequest,
    ContactsRequest,
    DistanceRequest,
    ObjectEntry,
    ObjectsRequest,
    RaycastRequest,
    SweepRequest,
    WithinRequest,
)
from solidcloud.schemas.wire.scene_messages import (
    AvatarInfo,
    ErrorReply,
    ReloadAnswer,
    SceneInfo,
    ScenesAnswer,
)
from solidcloud.server.runtime.stop_flag import StopFlag
from solidcloud.server.scene_interface import LimitReached
from solidcloud.server.zenoh_server import request_dispatcher as dispatcher_module
from solidcloud.server.zenoh_server.request_dispatcher import RequestDispatcher
from solidcloud.server.zenoh_server.server_config import ServerConfig

sys.path.insert(0, str(Path(__file__).parents[3] / "end_to_end"))
from fake_server import FloorScene, floor_simulation, floor_verdicts

POINTS = np.array([[0.0, 0.0, 0.5], [0.0, 0.25, 1.0]])


def key(operation, scene="floor", client="c"):
    return f"solidcloud/1/scene/{scene}/{client}/{operation}"


@pytest.fixture
def scene():
    return FloorScene()


@pytest.fixture
def service(scene):
    return RequestDispatcher([scene], ServerConfig(max_poses=5, max_avatar_points=4, max_in_flight=7))


# What ends every request of these tests early: it has to reach the scene.
STOP = StopFlag()


def ask(service, operation, request, encoding=MSGPACK, **where):
    payload = encode(request, encoding) if request is not None else b""
    return service.answer(key(operation, **where), payload, encoding, STOP)


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


EFFORT = {
    "budget_ms": 20.0,
    "radius_model": "local:0.5",
}
PLAIN = {"budget_ms": None, "radius_model": None}
TOLERANT = EFFORT | {"tolerance": 0.5}
LOOSE = TOLERANT | {"relative_tolerance": 0.25}
POSES = np.tile(np.eye(4), (3, 1, 1))
ONE = [ObjectEntry("al"), ObjectEntry("al", 2, 5)]
REQUESTS = [
    (CollideRequest("al", POSES, 0.125, **TOLERANT), 3, ("al", 0.125), TOLERANT),
    (DistanceRequest("al", POSES, 0.75, **LOOSE), 3, ("al", 0.75), LOOSE),
    (ContactsRequest("al", POSES, 9, 0.125, 0.5), 3, ("al", 9, 0.125, 0.5), PLAIN | {"tolerance": 0.0}),
    (
        SweepRequest(avatar="al", pose_from=POSES, pose_to=POSES, margin=0.125),
        3,
        ("al", 0.125),
        PLAIN | {"tolerance": 1e-6},
    ),
    (RaycastRequest(POINTS, POINTS, 2.0, **EFFORT), 2, (2.0,), EFFORT),
    (WithinRequest(POINTS, 2.0), 2, (2.0,), PLAIN),
    (
        ObjectsRequest(ONE, POSES[:2], 0.125),
        2,
        ((("al", 1, 2**32 - 1), ("al", 2, 5)), 0.125),
        PLAIN,
    ),
]


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
@pytest.mark.parametrize("request_, k, asked, effort", REQUESTS, ids=lambda value: type(value).__name__)
def test_what_is_asked_reaches_the_scene(service, scene, request_, k, asked, effort, encoding):
    operation = type(request_).__name__.removesuffix("Request").lower()
    ask(service, "add_avatar", AddAvatarRequest("al", POINTS, 0.25))
    answer = ask(service, operation, request_, encoding)
    found = decode_answer(QUESTIONS[operation].answers, answer.payload, encoding)
    assert answer.ok and len(check_answers(found, k)) == k
    assert scene.asked == [(operation, asked, effort | {"stop": STOP})]


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_a_move_is_asked_of_the_scene(service, scene, encoding):
    ask(service, "add_avatar", AddAvatarRequest("al", POINTS, 0.25))
    request = MoveRequest(avatar="al", pose_from=POSES[:1], pose_to=POSES[1:2], seconds=0.125)
    answer = ask(service, "move", request, encoding)
    moved = decode_answer(Moved, answer.payload, encoding)
    assert answer.ok and np.array_equal(moved.pose, POSES[1:2])
    assert (moved.verdict, moved.left, moved.simulated) == (1, 0.5, ["stop"])
    assert scene.asked == [("move", ("al", 0.125), {"late": "wait", "stop": STOP})]
    assert error(ask(service, "move", request, encoding, client="d"), encoding).code == "unknown_avatar"


def test_the_sessions_of_a_client_that_is_gone_end():
    scene = floor_simulation()
    service = RequestDispatcher([scene.scene], ServerConfig())
    sent = []
    frames = service.frames("floor", lambda user, answer: sent.append((user, answer.ok)))
    for client in ("c", "d"):
        ask(service, "add_avatar", AddAvatarRequest("al", POINTS, 0.25), client=client)
        wish = Wish(seq=1, time=0.0, pose=POSES[:1])
        frames.wish(User(client, "al"), encode(wish), None)
    service.client_gone("floor", "c")
    frames.close()
    frames.run()
    assert sent == [(User("d", "al"), True)] and scene.users == [User("d", "al")]


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_a_path_is_answered_in_parts(scene, encoding):
    service = RequestDispatcher([scene], ServerConfig())
    ask(service, "add_avatar", AddAvatarRequest("al", POINTS, 0.25))
    poses = np.tile(np.eye(4), (25, 1, 1))
    poses[:, 2, 3] = np.linspace(-0.4, 0.0, 25)
    answers = list(ask(service, "path", PathRequest("al", poses, margin=0.125, budget_ms=9.0), encoding))
    assert all(answer.ok and answer.encoding == encoding for answer in answers)
    parts = [decode_answer(CollidePart, answer.payload, encoding) for answer in answers]
    assert [(part.first, len(part), part.total) for part in parts] == [(0, 10, 25), (10, 10, 25), (20, 5, 25)]
    verdicts = np.concatenate([part.verdict for part in parts])
    assert np.array_equal(verdicts, floor_verdicts(POINTS, 0.25, poses, 0.125)) and {0, 1} == set(verdicts)
    assert scene.asked == [("path", ("al", "collide"), {"stop": STOP, "margin": 0.125, "budget_ms": 9.0})]


def test_what_ends_a_path_early_is_its_last_answer(scene, caplog):
    service = RequestDispatcher([scene], ServerConfig())
    poses = np.tile(np.eye(4), (25, 1, 1))
    for name, code in {"crash": "internal", "refuse": "bad_transform"}.items():
        ask(service, "add_avatar", AddAvatarRequest(name, POINTS))
        first, last = ask(service, "path", PathRequest(name, poses))
        assert first.ok and error(last).code == code and "secret" not in error(last).message
    assert error(ask(service, "path", PathRequest("bo", poses))).code == "unknown_avatar"


def test_an_answer_that_no_message_holds_is_too_large(service, monkeypatch):
    ask(service, "add_avatar", AddAvatarRequest("al", POINTS))
    monkeypatch.setattr(dispatcher_module, "MAX_MESSAGE_BYTES", (1 << 16) + 100)
    reply = error(ask(service, "collide", CollideRequest("al", np.eye(4)[None])))
    assert reply.code == "too_large" and "ask for less" in reply.message


@pytest.mark.parametrize(
    "request_",
    [
        RaycastRequest(np.ones((6, 3)), np.ones((6, 3)), 1.0),
        WithinRequest(np.ones((6, 3)), 1.0),
        PathRequest("al", np.zeros((6, 4, 4))),
        SweepRequest(avatar="al", pose_from=np.zeros((6, 4, 4)), pose_to=np.zeros((6, 4, 4))),
    ],
    ids=lambda value: type(value).__name__,
)
def test_every_list_has_a_cap(service, request_):
    operation = type(request_).__name__.removesuffix("Request").lower()
    assert error(ask(service, operation, request_)).code == "too_large"


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


def test_avatars_are_their_clients(service, scene):
    ask(service, "add_avatar", AddAvatarRequest("al", POINTS), client="one")
    pose = CollideRequest("al", np.eye(4)[None])
    assert ask(service, "collide", pose, client="one").ok
    assert error(ask(service, "collide", pose, client="two")).code == "unknown_avatar"
    service.client_gone("floor", "one")
    assert error(ask(service, "collide", pose, client="one")).code == "unknown_avatar"


def test_busy_says_how_many(service):
    assert error(service.busy(JSON, LimitReached.REQUESTS), JSON).code == "busy"
    assert "7 requests" in error(service.busy(None, LimitReached.REQUESTS)).message
    config = ServerConfig()
    said = {
        full: error(RequestDispatcher([FloorScene()], config).busy(None, full)).message
        for full in LimitReached
    }
    assert "64 requests of this client" in said[LimitReached.OWN_REQUESTS]
    assert "16 paths" in said[LimitReached.PATHS] and "8 of one client" in said[LimitReached.PATHS]
    assert "queries for states" in said[LimitReached.STATES]


def test_two_scenes_of_one_name_are_refused():
    with pytest.raises(BadRequestError, match="distinct names"):
        RequestDispatcher([FloorScene(), FloorScene()], ServerConfig())


def test_a_scene_whose_name_no_key_can_hold_is_refused():
    with pytest.raises(BadRequestError, match="expected 1 to 64"):
        RequestDispatcher([FloorScene("a/b")], ServerConfig())


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_a_reload_is_answered_in_one_part_when_it_is_taken(service, scene, encoding):
    answers = service.answer(key("reload"), b"", encoding)
    assert scene.reloaded == 0, "whoever sends the parts has it done"
    (answer,) = list(answers)
    assert answer.ok and scene.reloaded == 1
    assert decode_answer(ReloadAnswer, answer.payload, encoding) == ReloadAnswer("floor", 0, 1, 4)


def test_a_reload_that_fails_says_why(service, scene, caplog):
    scene.refuses = FormatError("no archive here")
    (answer,) = list(service.answer(key("reload"), b"", MSGPACK))
    assert error(answer).code == "corrupt" and "no archive here" in error(answer).message
    assert "floor cannot be reloaded and is served as before: no archive here" in caplog.text
    scene.refuses = RuntimeError("a secret of the server's own")
    (answer,) = list(service.answer(key("reload"), b"", MSGPACK))
    assert error(answer).code == "internal" and "secret" not in error(answer).message
