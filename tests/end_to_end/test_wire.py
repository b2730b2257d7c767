"""A client and a server over zenoh on loopback: what is answered, and what is said when nobody answers."""

import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgspec
import numpy as np
import pytest
import zenoh
from solidcloud.schemas.answers import Verdict
from solidcloud.schemas.errors import (
    BadRequestError,
    BadTransformError,
    BusyError,
    InternalError,
    SolidcloudError,
    TooLargeError,
    UnknownAvatarError,
    UnknownSceneError,
)
from solidcloud.schemas.messages import (
    JSON,
    MSGPACK,
    AvatarInfo,
    CollideRequest,
    ErrorReply,
    PathRequest,
    ScenesAnswer,
    decode_answer,
    encode,
)
from solidcloud.server import questions as questions_module
from solidcloud.server import transport as transport_module
from solidcloud.server.app import serve, serving
from solidcloud.server.client import Client
from solidcloud.server.config import ServerConfig
from solidcloud.server.transport import session_config

sys.path.insert(0, str(Path(__file__).parent))
from fake_server import FloorScene, floor_verdicts

POINTS = np.array([[0.0, 0.0, 0.5], [0.25, 0.0, 1.0], [0.0, 0.25, 1.5]])
DEADLINE = 20.0


@pytest.fixture
def endpoint():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    return f"tcp/127.0.0.1:{port}"


@pytest.fixture
def scene():
    return FloorScene()


@pytest.fixture
def client(scene, endpoint):
    with serving([scene], ServerConfig(listen=endpoint)), Client(endpoint, scene="floor") as client:
        yield client


@contextmanager
def server_process(endpoint, *arguments):
    """A server in a process of its own, ready. Ended with SIGKILL if it still runs."""
    command = [sys.executable, str(Path(__file__).parent / "fake_server.py"), endpoint, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout.readline().startswith("serving ")
            yield process
        finally:
            process.kill()


def eventually(condition):
    """Wait until a condition holds, at most until the deadline."""
    deadline = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < deadline, "never came true"
        time.sleep(0.01)


def heights(values):
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, 2, 3] = values
    return poses


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
    monkeypatch.setattr(questions_module, "BATCH_POSES", 7)
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


def test_nobody_there_is_unknown_until_a_server_comes(scene, endpoint):
    poses = heights([-1.0, 1.0])
    with Client(endpoint, scene="floor") as client:
        assert client.collide("al", poses).verdict.tolist() == [Verdict.UNKNOWN] * 2
        assert client.add_avatar("al", POINTS, 0.1) == AvatarInfo("al", 3, 0.1, None)
        with pytest.raises(BusyError, match="solidcloud serve"):
            client.info()
        with serving([scene], ServerConfig(listen=endpoint)):
            eventually(lambda: client.collide("al", poses).verdict.tolist() == [1, 0])
            assert client.info().scene == "floor"


def test_a_wrong_scene_name_is_told_by_a_server_that_comes_late(scene, endpoint):
    with (
        Client(endpoint, scene="hall") as client,
        serving([scene], ServerConfig(listen=endpoint)),
        pytest.raises(UnknownSceneError, match="floor"),
    ):
        eventually(lambda: client.collide("al", np.eye(4)[None]).verdict[0] != Verdict.UNKNOWN)


def test_a_killed_server_is_unknown_and_its_successor_right(endpoint):
    poses = heights([-1.0, 1.0])
    with Client(endpoint, scene="floor", timeout=2.0) as client:
        client.add_avatar("al", POINTS, 0.1)
        for _ in range(2):
            with server_process(endpoint) as process:
                eventually(lambda: client.collide("al", poses).verdict.tolist() == [1, 0])
                process.kill()
                process.wait(DEADLINE)
                for _ in range(5):
                    assert client.collide("al", poses).verdict.tolist() == [Verdict.UNKNOWN] * 2


def test_a_frozen_server_is_unknown_after_the_timeout(endpoint, monkeypatch):
    monkeypatch.setattr(questions_module, "BATCH_POSES", 1)
    poses = heights([-1.0, 1.0, 1.0])
    with server_process(endpoint) as process, Client(endpoint, scene="floor", timeout=0.3) as client:
        client.add_avatar("al", POINTS, 0.1)
        process.send_signal(signal.SIGSTOP)
        asked = time.monotonic()
        assert client.collide("al", poses).verdict.tolist() == [Verdict.UNKNOWN] * 3
        assert time.monotonic() - asked < DEADLINE
        process.send_signal(signal.SIGCONT)
        eventually(lambda: client.collide("al", poses).verdict.tolist() == [1, 0, 0])


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


def joined(parts):
    """The verdicts of a path's parts, which are all of it and in order."""
    stops = np.cumsum([len(part) for part in parts]).tolist()
    assert [part.first for part in parts] == [0, *stops[:-1]]
    assert {part.total for part in parts} == {stops[-1]}
    return np.concatenate([part.verdict for part in parts])


PATH = heights(np.random.default_rng(6).normal(-0.5, 0.3, 95))
TRUTH = floor_verdicts(POINTS, 0.125, PATH)


def test_a_path_comes_in_parts_and_in_order(client):
    client.add_avatar("al", POINTS, 0.125)
    parts = list(client.path("al", PATH))
    assert len(parts) == 10
    assert np.array_equal(joined(parts), TRUTH) and {0, 1} == set(TRUTH)


def test_a_path_that_nobody_answers_is_unknown_until_a_server_comes(scene, endpoint):
    with Client(endpoint, scene="floor") as client:
        client.add_avatar("al", POINTS, 0.125)
        assert set(joined(list(client.path("al", PATH)))) == {Verdict.UNKNOWN}
        with serving([scene], ServerConfig(listen=endpoint)):
            eventually(lambda: np.array_equal(joined(list(client.path("al", PATH))), TRUTH))


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGSTOP])
def test_a_server_that_ends_in_mid_path_leaves_the_rest_unknown(endpoint, end):
    with server_process(endpoint, "--delay", "0.1") as process, Client(endpoint, scene="floor") as client:
        client.add_avatar("al", POINTS, 0.125)
        client._timeout = 1.0
        parts = []
        for part in client.path("al", PATH):
            parts.append(part)
            if len(parts) == 3:
                process.send_signal(end)
        process.kill()
    verdicts = joined(parts)
    known = verdicts != Verdict.UNKNOWN
    assert 30 <= known.sum() < len(PATH)
    assert known[: known.sum()].all() and np.array_equal(verdicts[known], TRUTH[known])


@pytest.mark.parametrize(
    "order, known",
    [
        ([0, 1, 2, 4, 5, 6, 7, 8, 9], [0, 1, 2, 4, 5, 6, 7, 8, 9]),
        ([1, 2], [1, 2]),
        ([0, 1, 1, 0, 2, 3, 4, 5, 6, 7, 8, 9], range(10)),
        ([0, 2, 1, 3], [0, 2, 3]),
        ([9], [9]),
        ([], []),
    ],
)
def test_parts_that_are_lost_are_unknown_and_none_counts_twice(client, scene, monkeypatch, order, known):
    client.add_avatar("al", POINTS, 0.125)
    whole = FloorScene.path
    monkeypatch.setattr(
        scene,
        "path",
        lambda *a, **b: (lambda parts: iter([parts[i] for i in order]))(list(whole(scene, *a, **b))),
    )
    verdicts = joined(list(client.path("al", PATH)))
    told = np.isin(np.arange(95) // 10, list(known))
    assert np.array_equal(verdicts[told], TRUTH[told])
    assert (verdicts[~told] == Verdict.UNKNOWN).all()


@pytest.mark.parametrize("change", [{"total": 96}, {"first": -10}, {"first": 90}])
def test_parts_that_are_none_of_the_path_are_internal_errors(client, scene, monkeypatch, change):
    client.add_avatar("al", POINTS, 0.125)
    whole = FloorScene.path
    monkeypatch.setattr(
        scene,
        "path",
        lambda *a, **b: (msgspec.structs.replace(part, **change) for part in whole(scene, *a, **b)),
    )
    with pytest.raises(InternalError, match="expected some of 95"):
        list(client.path("al", PATH))


def test_what_goes_wrong_along_a_path_is_raised_after_what_went_right(client):
    client.add_avatar("refuse", POINTS)
    parts = client.path("refuse", PATH)
    assert len(next(parts)) == 10
    with pytest.raises(BadTransformError):
        next(parts)
    with pytest.raises(UnknownAvatarError, match="bo"):
        list(client.path("bo", PATH))


def test_a_server_that_forgot_an_avatar_is_given_it_again_for_a_path(client, scene):
    client.add_avatar("al", POINTS, 0.125)
    scene.avatars.clear()
    assert np.array_equal(joined(list(client.path("al", PATH))), TRUTH)


def test_long_paths_hold_up_nobody_else(client, scene, endpoint):
    config = ServerConfig().workers
    with ExitStack() as stack:
        walkers = [
            stack.enter_context(Client(endpoint, scene="floor", timeout=DEADLINE)) for _ in range(config + 1)
        ]
        paths = []
        for walker in walkers:
            walker.add_avatar("wait", POINTS, 0.125)
            paths.append(walker.path("wait", PATH))
            next(paths[-1])
        client.add_avatar("al", POINTS, 0.125)
        for _ in range(20):
            assert client.collide("al", heights([-1.0])).verdict.tolist() == [Verdict.CONTACT]
        scene.gate.set()
        for path in paths:
            assert sum(len(part) for part in path) == 85


def test_a_client_may_ask_while_its_path_is_on_its_way(client, scene):
    client.add_avatar("wait", POINTS, 0.125)
    client.add_avatar("al", POINTS, 0.125)
    path = client.path("wait", PATH)
    first = next(path)
    assert np.array_equal(joined(list(client.path("al", PATH))), TRUTH)
    assert client.collide("al", heights([-1.0])).verdict.tolist() == [Verdict.CONTACT]
    scene.gate.set()
    assert np.array_equal(joined([first, *path]), TRUTH)


def test_a_client_that_goes_is_sent_no_more_parts(scene, endpoint):
    with serving([scene], ServerConfig(listen=endpoint)):
        with Client(endpoint, scene="floor", timeout=DEADLINE) as client:
            client.add_avatar("wait", POINTS, 0.125)
            path = client.path("wait", PATH)
            next(path)
            client.close()
        eventually(lambda: scene.gone)
        scene.gate.set()
        eventually(lambda: not sending())
    assert scene.parts <= 2 and not scene.avatars


def test_a_client_whose_token_goes_is_sent_no_more_parts(scene, endpoint):
    with (
        serving([scene], ServerConfig(listen=endpoint)),
        zenoh.open(session_config(connect=endpoint)) as session,
    ):
        token = session.liveliness().declare_token("solidcloud/1/client/floor/c")
        scene.avatars["c", "wait"] = (POINTS, 0.125)
        request = encode(PathRequest("wait", PATH))
        # By default zenoh keeps of several replies the last.
        every = {"consolidation": zenoh.ConsolidationMode.NONE, "timeout": DEADLINE}
        replies = session.get("solidcloud/1/scene/floor/c/path", payload=request, **every)
        assert replies.recv().ok
        token.undeclare()
        eventually(lambda: scene.gone)
        scene.gate.set()
        assert not list(replies), "its link is there, but nobody who asked"


def sending():
    """The threads that send parts."""
    return [thread for thread in threading.enumerate() if thread.name == "solidcloud-floor-parts"]


def test_paths_that_ended_are_no_longer_in_flight(scene, endpoint, monkeypatch):
    made = []

    class Queues(transport_module.FairQueues):
        def __init__(self, *bounds):
            super().__init__(*bounds)
            made.append(self)

    monkeypatch.setattr(transport_module, "FairQueues", Queues)
    with serving([scene], ServerConfig(listen=endpoint)), Client(endpoint, scene="floor") as client:
        client.add_avatar("al", POINTS, 0.125)
        client.add_avatar("wait", POINTS, 0.125)
        path = client.path("wait", PATH)
        next(path)
        assert np.array_equal(joined(list(client.path("al", PATH))), TRUTH)
        eventually(lambda: len(sending()) == 1)
        assert len(made[0]) == 1
        scene.gate.set()
        assert sum(len(part) for part in path) == 85
        eventually(lambda: not sending())
        assert len(made[0]) == 0


def test_more_paths_than_the_server_takes_are_busy(scene, endpoint):
    with (
        serving([scene], ServerConfig(listen=endpoint, max_paths=1)),
        Client(endpoint, scene="floor", timeout=DEADLINE) as one,
        Client(endpoint, scene="floor", timeout=DEADLINE) as two,
    ):
        one.add_avatar("wait", POINTS, 0.125)
        two.add_avatar("al", POINTS, 0.125)
        path = one.path("wait", PATH)
        next(path)
        with pytest.raises(BusyError):
            list(two.path("al", PATH))
        assert two.collide("al", heights([-1.0])).verdict.tolist() == [Verdict.CONTACT]
        scene.gate.set()
        assert sum(len(part) for part in path) == 85
        assert np.array_equal(joined(list(two.path("al", PATH))), TRUTH)


def test_a_server_that_stops_finishes_the_paths_it_accepted(scene, endpoint):
    with Client(endpoint, scene="floor", timeout=DEADLINE) as client:
        with serving([scene], ServerConfig(listen=endpoint)):
            client.add_avatar("al", POINTS, 0.125)
            eventually(lambda: client.collide("al", heights([-1.0])).verdict.tolist() == [Verdict.CONTACT])
            client.add_avatar("wait", POINTS, 0.125)
            path = client.path("wait", PATH)
            first = next(path)
            threading.Timer(0.2, scene.gate.set).start()
        assert np.array_equal(joined([first, *path]), TRUTH)


def test_a_server_that_stops_gives_up_what_takes_too_long(endpoint):
    """A path without end in sight, and a queue behind a slow answer: cut short, and no thread is left at work."""
    scene = FloorScene(delay=0.05)
    with Client(endpoint, scene="floor", timeout=DEADLINE) as client, ExitStack() as stack:
        with serving([scene], ServerConfig(listen=endpoint, stop_seconds=0.1)):
            client.add_avatar("al", POINTS, 0.125)
            eventually(lambda: client.collide("al", heights([-1.0])).verdict.tolist() == [Verdict.CONTACT])
            path = client.path("al", np.tile(PATH, (100, 1, 1)))
            first = next(path)
            asked = [threading.Thread(target=client.collide, args=("al", PATH)) for _ in range(100)]
            for thread in asked:
                thread.start()
                stack.callback(thread.join)
            eventually(lambda: scene.at_work > 3)
        assert [t.name for t in threading.enumerate() if t.name.startswith("solidcloud-")] == []
        verdicts = joined([first, *path])
        assert len(verdicts) == 100 * len(PATH) and verdicts[-1] == Verdict.UNKNOWN
        assert scene.parts < 40 and scene.at_work < 100


@pytest.mark.parametrize(
    "ask",
    [
        lambda client: client.collide("al", PATH),
        lambda client: client.collide("al", PATH, budget_visits=5),
        lambda client: client.distance("al", PATH, 1.0),
        lambda client: client.contacts("al", PATH),
        lambda client: client.sweep("al", PATH, PATH),
        lambda client: client.raycast(PATH[:, :3, 3], np.ones((95, 3)), 1.0),
        lambda client: client.within(PATH[:, :3, 3], 1.0),
        lambda client: client.objects([("al", pose) for pose in PATH]),
    ],
    ids=["collide", "budget", "distance", "contacts", "sweep", "raycast", "within", "objects"],
)
def test_every_question_that_nobody_answers_is_unknown(endpoint, ask):
    with Client(endpoint, scene="floor") as client:
        client.add_avatar("al", POINTS, 0.125)
        answers = ask(client)
    assert answers.verdict.tolist() == [Verdict.UNKNOWN] * 95
    for name, value in {
        "lower": -np.inf,
        "upper": np.inf,
        "distance": np.inf,
        "signed_distance": np.inf,
    }.items():
        found = getattr(answers, name, np.zeros(0))
        assert ((found == value) | ((name == "lower") & (found == 0))).all()
    if hasattr(answers, "pairs"):
        assert len(answers.pairs) == 95 * 94 // 2 and (answers.pair_verdict == Verdict.UNKNOWN).all()
    assert not getattr(answers, "exact", np.zeros(0)).any()


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


def test_terminated_server_answers_what_it_accepted_and_exits_0(endpoint):
    with server_process(endpoint, "--delay", "0.005") as process:
        with (
            Client(endpoint, scene="floor") as client,
            zenoh.open(session_config(connect=endpoint)) as session,
        ):
            client.add_avatar("al", POINTS, 0.1)
            payload = encode(CollideRequest("al", heights([-1.0])))
            key = f"solidcloud/1/scene/floor/{client._id}/collide"
            asked = [session.get(key, payload=payload, timeout=DEADLINE) for _ in range(60)]
            # Answered by the other worker, and asked after the sixty on the same link: all have arrived.
            assert next(iter(session.get("solidcloud/1/scene/floor/other/info"))).ok
            process.send_signal(signal.SIGTERM)
            replies = [reply for handler in asked for reply in handler]
        assert process.wait(DEADLINE) == 0
    assert len(replies) == 60 and all(reply.ok for reply in replies)


def test_interrupted_server_exits_0(endpoint):
    with server_process(endpoint) as process:
        process.send_signal(signal.SIGINT)
        assert process.wait(DEADLINE) == 0


def test_a_signal_that_another_thread_takes_stops_the_server(scene, endpoint):
    stopped, in_time = threading.Event(), []

    def signal_this_thread():
        with Client(endpoint, scene="floor") as client:
            client.add_avatar("al", POINTS)
            eventually(lambda: client.collide("al", heights([1.0])).verdict[0] == Verdict.CLEAR)
        signal.pthread_kill(threading.get_ident(), signal.SIGTERM)
        in_time.append(stopped.wait(DEADLINE))
        if not in_time[0]:
            signal.pthread_kill(threading.main_thread().ident, signal.SIGTERM)

    thread = threading.Thread(target=signal_this_thread)
    before = signal.getsignal(signal.SIGTERM)
    thread.start()
    serve([scene], ServerConfig(listen=endpoint))
    stopped.set()
    thread.join(DEADLINE)
    assert in_time == [True]
    assert signal.getsignal(signal.SIGTERM) == before


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
        assert scene.warmed == 1 and not scene.gone


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
    # The server refuses so many at once (test_app.py); the client asks for them in halves.
    monkeypatch.setattr(questions_module, "BATCH_POSES", 10**6)
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
