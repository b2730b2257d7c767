"""Test a server that is absent, late, stopped or frozen: what it does not answer is unknown."""

import signal
import time

import numpy as np
import pytest
from floor import DEADLINE, PATH, POINTS, eventually, heights, server_process
from frozen_processes import freeze
from solidcloud.schemas.errors import (
    BusyError,
    UnknownSceneError,
)
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.scene_messages import AvatarInfo
from solidcloud.server import client as client_module
from solidcloud.server.client import Client
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig


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
    monkeypatch.setattr(client_module, "BATCH_POSES", 1)
    poses = heights([-1.0, 1.0, 1.0])
    with server_process(endpoint) as process, Client(endpoint, scene="floor", timeout=0.3) as client:
        client.add_avatar("al", POINTS, 0.1)
        freeze(process.pid)
        asked = time.monotonic()
        assert client.collide("al", poses).verdict.tolist() == [Verdict.UNKNOWN] * 3
        assert time.monotonic() - asked < DEADLINE
        process.send_signal(signal.SIGCONT)
        eventually(lambda: client.collide("al", poses).verdict.tolist() == [1, 0, 0])


@pytest.mark.parametrize(
    "ask",
    [
        lambda client: client.collide("al", PATH),
        lambda client: client.collide("al", PATH, tolerance=0.1),
        lambda client: client.distance("al", PATH, 1.0),
        lambda client: client.contacts("al", PATH),
        lambda client: client.sweep("al", PATH, PATH),
        lambda client: client.raycast(PATH[:, :3, 3], np.ones((95, 3)), 1.0),
        lambda client: client.within(PATH[:, :3, 3], 1.0),
        lambda client: client.objects([("al", pose) for pose in PATH]),
    ],
    ids=["collide", "tolerance", "distance", "contacts", "sweep", "raycast", "within", "objects"],
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
