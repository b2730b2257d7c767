"""Test paths over zenoh: the parts arrive in order, and missing parts are unknown."""

import signal
from contextlib import ExitStack

import msgspec
import numpy as np
import pytest
import zenoh
from fake_server import FloorScene
from floor import DEADLINE, PATH, POINTS, TRUTH, eventually, heights, joined, sending, server_process
from solidcloud.schemas.errors import (
    BadTransformError,
    BusyError,
    InternalError,
    UnknownAvatarError,
)
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.encoding import encode
from solidcloud.schemas.wire.path_messages import PathRequest
from solidcloud.server.client import Client
from solidcloud.server.zenoh_common.zenoh_settings import session_config
from solidcloud.server.zenoh_server import request_lanes as lanes_module
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig


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
        client._connection.timeout = 2.0
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
        # By default zenoh keeps only the last of several replies.
        every = {"consolidation": zenoh.ConsolidationMode.NONE, "timeout": DEADLINE}
        replies = session.get("solidcloud/1/scene/floor/c/path", payload=request, **every)
        assert replies.recv().ok
        token.undeclare()
        eventually(lambda: scene.gone)
        scene.gate.set()
        assert not list(replies), "its link is there, but nobody who asked"


def test_paths_that_ended_are_no_longer_in_flight(scene, endpoint, monkeypatch):
    made = []

    class Queues(lanes_module.FairQueues):
        def __init__(self, *bounds):
            super().__init__(*bounds)
            made.append(self)

    monkeypatch.setattr(lanes_module, "FairQueues", Queues)
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

        def answered():
            try:  # the server frees the path's place only after its last part
                return np.array_equal(joined(list(two.path("al", PATH))), TRUTH)
            except BusyError:
                return False

        eventually(answered)
