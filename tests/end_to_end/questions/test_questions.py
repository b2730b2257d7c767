"""Test every query over zenoh: the answers equal those of the scene in this process, bit for bit."""

import importlib
import pkgutil
import threading
from concurrent.futures import ThreadPoolExecutor

import archive_cases
import numpy as np
import pytest
import zenoh
from corner import (
    ENDS,
    POINTS,
    POSES,
    QUESTIONS,
    RAYS,
    RNG,
    TOWARDS,
    add_avatars,
    same,
)
from solidcloud.schemas.errors import TooLargeError
from solidcloud.schemas.wire import key_expressions
from solidcloud.schemas.wire.encoding import JSON, MSGPACK, decode_answer, encode
from solidcloud.schemas.wire.path_messages import part_to_answers
from solidcloud.schemas.wire.question_table import check_answers, join_answers
from solidcloud.server import kernels
from solidcloud.server.client import Client
from solidcloud.server.queries import path as path_module
from solidcloud.server.scene import Scene
from solidcloud.server.zenoh_common.zenoh_settings import session_config


@pytest.mark.parametrize("question", QUESTIONS)
def test_client_answers_as_the_scene_does(scene, client, question):
    ask, _, kind, k = QUESTIONS[question]
    expected = ask(scene)
    assert isinstance(expected, kind) and len(expected) == k
    assert len(set(expected.verdict.tolist())) > 1, "a question with one answer to all shows little"
    same(ask(client), expected)


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
@pytest.mark.parametrize("question", QUESTIONS)
def test_plain_zenoh_is_answered_as_the_scene_does(scene, endpoint, question, encoding):
    ask, request, kind, k = QUESTIONS[question]
    key = key_expressions.query_key("hall", "plain", question.partition("-")[0])
    with zenoh.open(session_config(connect=endpoint)) as session:
        (reply,) = session.get(key, payload=encode(request, encoding), encoding=encoding)
    assert reply.ok is not None, reply.err.payload.to_bytes()
    assert str(reply.ok.encoding) == encoding
    same(check_answers(decode_answer(kind, reply.ok.payload.to_bytes(), encoding), k), ask(scene))


@pytest.mark.parametrize("question", QUESTIONS)
def test_what_is_split_is_what_was_asked_at_once(scene, client, question, monkeypatch):
    from solidcloud.server import client as client_module

    monkeypatch.setattr(client_module, "BATCH_POSES", 7)
    monkeypatch.setattr(client_module, "SLOW_BATCH", 7)
    ask, _, _, _ = QUESTIONS[question]
    same(ask(client), ask(scene))


def test_contacts_that_no_message_holds_come_in_smaller_ones(scene, client, monkeypatch):
    """Test many clusters with small messages: `limit` does not bound clusters."""
    from solidcloud.server.zenoh_server import request_dispatcher as dispatcher_module

    parameters = {"limit": 0, "margin": 0.5, "cluster_distance": 0.0}
    expected = scene.contacts("al", POSES, **parameters)
    most = 116 * int(np.diff(expected.cluster_starts).max())
    assert most > 1000 and 116 * expected.cluster_starts[-1] > 3 * most
    monkeypatch.setattr(dispatcher_module, "MAX_MESSAGE_BYTES", (1 << 16) + most + 5000)
    monkeypatch.setattr(path_module, "_PART_BYTES", most)
    same(client.contacts("al", POSES, **parameters), expected)
    parts = [part_to_answers(part) for part in client.path("al", POSES, "contacts", **parameters)]
    same(join_answers(parts), expected)
    monkeypatch.setattr(dispatcher_module, "MAX_MESSAGE_BYTES", (1 << 16) + 1000)
    with pytest.raises(TooLargeError, match="a message holds"):
        client.contacts("al", POSES, **parameters)


def compiled():
    """Return the number of compiled versions of each kernel; empty if interpreted."""
    found = {}
    for found_module in pkgutil.walk_packages(kernels.__path__, f"{kernels.__name__}."):
        module = importlib.import_module(found_module.name)
        for name, kernel in vars(module).items():
            if hasattr(kernel, "signatures"):
                found[found_module.name, name] = len(kernel.signatures)
    return found


def test_who_asks_after_warming_waits_for_no_compiler(tmp_path):
    with Scene.open(archive_cases.build(tmp_path, POINTS).archive) as scene:
        scene.warm()
        before = compiled()
        add_avatars(scene)
        scene.add_avatar("cy", np.asfortranarray(RNG.normal(size=(700, 3))), 0.01)
        scene.add_avatar("dot", np.zeros((1, 3)), 0.01)
        poses = POSES.copy()
        poses.flags.writeable = False
        efforts = (
            {},
            {"tolerance": 0.01},
            {"budget_ms": 1e4},
            {"budget_ms": 1e4, "tolerance": 0.01},
        )
        for name in ("al", "cy", "dot"):
            for effort in efforts:
                scene.collide(name, poses[:1], **effort)
                scene.collide(name, poses, 0.01, **effort)
                scene.distance(name, poses, 0.05, **effort)
                scene.contacts(name, poses, 3, 0.05, 0.1, **effort)
                scene.sweep(name, poses, ENDS, **effort)
                list(scene.path(name, poses, "distance", reach=0.1, **effort))
                budget = {option: effort[option] for option in effort if option != "tolerance"}
                scene.raycast(RAYS, TOWARDS, 1.5, **budget)
                scene.within(RAYS, 0.5, **budget)
                scene.objects([(name, poses[0]), ("bo", poses[0], 2)], **budget)
        assert compiled() == before


def test_two_clients_at_once_are_each_answered_in_order(scene, endpoint):
    poses = np.tile(POSES, (200, 1, 1))
    expected = scene.collide("al", poses).verdict
    assert {0, 1} <= set(expected.tolist())
    begin = threading.Barrier(4)

    def walk(order):
        with Client(endpoint, scene="hall", timeout=30.0) as client:
            add_avatars(client)
            begin.wait(30)
            verdicts = [np.concatenate([part.verdict for part in client.path("al", poses[order])])]
            verdicts.append(client.collide("al", poses[order]).verdict)
            return verdicts

    orders = [np.roll(np.arange(len(poses)), shift) for shift in (0, 17, 171, 1711)]
    with ThreadPoolExecutor(4) as pool:
        for order, verdicts in zip(orders, pool.map(walk, orders), strict=True):
            for found in verdicts:
                assert np.array_equal(found, expected[order])
