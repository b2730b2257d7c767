"""Every question over zenoh: what comes back is what the scene in this process says, bit for bit."""

import importlib
import threading
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cases
import classes
import numpy as np
import pytest
import scans
import zenoh
from msgspec import structs
from solidcloud.schemas import keys
from solidcloud.schemas.answers import (
    PARTS,
    PATH_ANSWERS,
    CollideAnswers,
    ContactsAnswers,
    DistanceAnswers,
    ObjectsAnswers,
    RaycastAnswers,
    SweepAnswers,
    Verdict,
    WithinAnswers,
)
from solidcloud.schemas.arrays import array_fields
from solidcloud.schemas.columns import join, without_part
from solidcloud.schemas.errors import BadRequestError, BadTransformError, TooLargeError
from solidcloud.schemas.messages import (
    JSON,
    MSGPACK,
    CollideRequest,
    ContactsRequest,
    DistanceRequest,
    ObjectsRequest,
    PathRequest,
    RaycastRequest,
    SweepRequest,
    WithinRequest,
    check_answers,
    decode_answer,
    encode,
)
from solidcloud.schemas.requests import make_objects
from solidcloud.server import kernels
from solidcloud.server import path as path_module
from solidcloud.server.app import serving
from solidcloud.server.client import Client
from solidcloud.server.config import ServerConfig
from solidcloud.server.report.serving import free_port
from solidcloud.server.scene import Scene
from solidcloud.server.transport import session_config

BODY = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.0, 0.2, 0], [0.05, 0.05, 0.3]])
POINTS = scans.make_scan("corner", 4, 300)
RNG = np.random.default_rng(11)
POSES = cases.near_poses(RNG, POINTS, BODY, 40, 0.1)
ENDS = cases.near_poses(RNG, POINTS, BODY, 40, 0.1)
RAYS = POINTS[:30] + RNG.normal(0, 0.5, (30, 3))
TOWARDS = np.where(np.arange(30)[:, None] % 2, POINTS[:30] - RAYS, RNG.normal(size=(30, 3)))
OBJECTS = [("al", POSES[0]), ("bo", POSES[0], 2), ("al", POSES[1], 4, 1), ("bo", POSES[2], 1, 0xFFFFFFFE)]
ITEMS, PLACES = make_objects(OBJECTS)

# What is asked of a scene and a client, the same as a request, the type of the answer, and how many.
QUESTIONS = {
    "collide": (
        lambda scene: scene.collide("al", POSES, 0.02),
        CollideRequest("al", POSES, 0.02),
        CollideAnswers,
        40,
    ),
    "collide-bounded": (
        lambda scene: scene.collide("al", POSES, tolerance=0.01, budget_visits=30),
        CollideRequest("al", POSES, tolerance=0.01, budget_visits=30),
        CollideAnswers,
        40,
    ),
    "distance": (
        lambda scene: scene.distance("al", POSES, 0.05),
        DistanceRequest("al", POSES, 0.05),
        DistanceAnswers,
        40,
    ),
    "contacts": (
        lambda scene: scene.contacts("al", POSES, 3, 0.05, 0.1),
        ContactsRequest("al", POSES, 3, 0.05, 0.1),
        ContactsAnswers,
        40,
    ),
    "sweep": (
        lambda scene: scene.sweep("al", POSES, ENDS, 0.01, tolerance=1e-4),
        SweepRequest(avatar="al", pose_from=POSES, pose_to=ENDS, margin=0.01, tolerance=1e-4),
        SweepAnswers,
        40,
    ),
    "raycast": (
        lambda scene: scene.raycast(RAYS, TOWARDS, 1.5),
        RaycastRequest(RAYS, TOWARDS, 1.5),
        RaycastAnswers,
        30,
    ),
    "within": (lambda scene: scene.within(RAYS, 0.5), WithinRequest(RAYS, 0.5), WithinAnswers, 30),
    "objects": (
        lambda scene: scene.objects(OBJECTS, 0.01),
        ObjectsRequest(ITEMS, PLACES, 0.01),
        ObjectsAnswers,
        4,
    ),
}

# The same with spheres of several sizes.
MODELS = {
    "collide": "border:2",
    "distance": "local:0.1",
    "contacts": "local+border:0.2",
    "sweep": "border:2",
    "raycast": "fixed:0.04",
    "objects": "local:0.1",
}
QUESTIONS |= {
    f"{op}-{model}": (
        lambda scene, ask=QUESTIONS[op][0], model=model: ask(_WithModel(scene, model)),
        structs.replace(QUESTIONS[op][1], radius_model=model),
        *QUESTIONS[op][2:],
    )
    for op, model in MODELS.items()
}


class _WithModel:
    """A scene or client all of whose questions are asked with one radius model."""

    def __init__(self, scene, model):
        self._scene, self._model = scene, model

    def __getattr__(self, name):
        return partial(getattr(self._scene, name), radius_model=self._model)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    with classes.any_classes():
        case = cases.build(tmp_path_factory.mktemp("corner"), POINTS, models=classes.STORED)
    with Scene.open(case.archive, "hall") as scene:
        add_avatars(scene)
        add_avatars(scene, client="plain")
        yield scene


@pytest.fixture(scope="module")
def endpoint(scene):
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with serving([scene], ServerConfig(listen=endpoint)):
        yield endpoint


@pytest.fixture
def client(endpoint):
    with Client(endpoint, scene="hall", timeout=30.0) as client:
        add_avatars(client)
        yield client


def add_avatars(scene, **client):
    scene.add_avatar("al", BODY, 0.01, **client)
    scene.add_avatar("bo", BODY[:2] + 0.01, 0.02, **client)


def same(one, other):
    """Whether two answers are one, what they cost in time and loads apart."""
    assert type(one) is type(other)
    for name in array_fields(type(one)):
        a, b = getattr(one, name), getattr(other, name)
        assert (a.dtype, a.shape) == (b.dtype, b.shape), name
        assert a.tobytes() == b.tobytes(), name


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
    key = keys.question_key("hall", "plain", question.partition("-")[0])
    with zenoh.open(session_config(connect=endpoint)) as session:
        (reply,) = session.get(key, payload=encode(request, encoding), encoding=encoding)
    assert reply.ok is not None, reply.err.payload.to_bytes()
    assert str(reply.ok.encoding) == encoding
    same(check_answers(decode_answer(kind, reply.ok.payload.to_bytes(), encoding), k), ask(scene))


@pytest.mark.parametrize("question", QUESTIONS)
def test_what_is_split_is_what_was_asked_at_once(scene, client, question, monkeypatch):
    from solidcloud.server import questions as questions_module

    monkeypatch.setattr(questions_module, "BATCH_POSES", 7)
    monkeypatch.setattr(questions_module, "SLOW_BATCH", 7)
    ask, _, _, _ = QUESTIONS[question]
    same(ask(client), ask(scene))


def test_contacts_that_no_message_holds_come_in_smaller_ones(scene, client, monkeypatch):
    """Clusters are not bounded by `limit`: here there are many of them, and messages are small."""
    from solidcloud.server import app as app_module

    parameters = {"limit": 0, "margin": 0.5, "cluster_distance": 0.0}
    expected = scene.contacts("al", POSES, **parameters)
    most = 116 * int(np.diff(expected.cluster_starts).max())
    assert most > 1000 and 116 * expected.cluster_starts[-1] > 3 * most
    monkeypatch.setattr(app_module, "MAX_MESSAGE_BYTES", (1 << 16) + most + 5000)
    monkeypatch.setattr(path_module, "_PART_BYTES", most)
    same(client.contacts("al", POSES, **parameters), expected)
    parts = [
        without_part(ContactsAnswers, part) for part in client.path("al", POSES, "contacts", **parameters)
    ]
    same(join(parts), expected)
    monkeypatch.setattr(app_module, "MAX_MESSAGE_BYTES", (1 << 16) + 1000)
    with pytest.raises(TooLargeError, match="a message holds"):
        client.contacts("al", POSES, **parameters)


@pytest.mark.parametrize(
    "op, parameters",
    [
        ("collide", {}),
        ("collide", {"margin": 0.02, "tolerance": 0.01, "budget_visits": 30}),
        ("distance", {"reach": 0.05}),
        ("contacts", {"limit": 3, "margin": 0.05, "cluster_distance": 0.1}),
        ("sweep", {"margin": 0.01, "tolerance": 1e-4}),
        ("collide", {"radius_model": "border:2"}),
        ("sweep", {"radius_model": "local:0.1"}),
    ],
)
def test_a_path_is_its_question_in_parts(scene, client, op, parameters, monkeypatch):
    monkeypatch.setattr(path_module, "FIRST_PART", 3)
    monkeypatch.setattr(path_module, "LARGEST_PART", 9)
    if op == "sweep":
        expected = scene.sweep("al", POSES[:-1], POSES[1:], **parameters)
    else:
        expected = getattr(scene, op)("al", POSES, **parameters)
    for parts in (
        list(scene.path("al", POSES, op, threads=1, **parameters)),
        list(scene.path("al", POSES, op, **parameters)),
        list(client.path("al", POSES, op, **parameters)),
    ):
        assert len(parts) > 3
        stops = np.cumsum([len(part) for part in parts]).tolist()
        assert [part.first for part in parts] == [0, *stops[:-1]]
        assert {part.total for part in parts} == {stops[-1]} == {len(expected)}
        same(join([without_part(type(expected), part) for part in parts]), expected)


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
@pytest.mark.parametrize("op, parameters", [("distance", {"reach": 0.05}), ("contacts", {}), ("sweep", {})])
def test_plain_zenoh_gets_the_parts_of_a_path(scene, endpoint, op, parameters, encoding, monkeypatch):
    monkeypatch.setattr(path_module, "FIRST_PART", 3)
    monkeypatch.setattr(path_module, "LARGEST_PART", 9)
    expected = list(scene.path("al", POSES, op, **parameters))
    key = keys.question_key("hall", "plain", "path")
    payload = encode(PathRequest("al", POSES, op, **parameters), encoding)
    with zenoh.open(session_config(connect=endpoint)) as session:
        every = {"consolidation": zenoh.ConsolidationMode.NONE, "encoding": encoding}
        replies = [reply.ok.payload.to_bytes() for reply in session.get(key, payload=payload, **every)]
    assert len(replies) > 3
    kind = PATH_ANSWERS[op]
    parts = [decode_answer(PARTS[kind], reply, encoding) for reply in replies]
    same(
        join([without_part(kind, part) for part in parts]),
        join([without_part(kind, part) for part in expected]),
    )


@pytest.mark.parametrize(
    "op, poses, total", [("collide", 0, 0), ("sweep", 0, 0), ("sweep", 1, 0), ("collide", 1, 1)]
)
def test_the_shortest_paths_have_one_part(scene, client, op, poses, total):
    for one in (scene, client):
        (part,) = one.path("al", POSES[:poses], op)
        assert (part.first, part.total, len(part)) == (0, total, total)


def test_a_bad_pose_far_along_a_path_is_named_before_any_part(scene, client, monkeypatch):
    monkeypatch.setattr(path_module, "FIRST_PART", 3)
    poses = POSES.copy()
    poses[33, 3, 0] = 1.0
    for one in (scene, client):
        with pytest.raises(BadTransformError, match="pose 33 "):
            next(iter(one.path("al", poses)))


@pytest.mark.parametrize(
    "op, parameters, said",
    [
        ("raycast", {}, "expected one of collide, distance, contacts, sweep"),
        ("collide", {"reach": 1.0}, "reach is no parameter of collide"),
        ("distance", {}, "needs reach"),
        ("distance", {"reach": 1.0, "limit": 3}, "limit is no parameter of distance"),
        ("sweep", {"margin": -1.0}, "margin"),
        ("collide", {"tolerance": np.inf}, "tolerance"),
        ("contacts", {"limit": -1}, "limit"),
    ],
)
def test_parameters_that_do_not_fit_are_refused_by_both(scene, client, op, parameters, said):
    for one in (scene, client):
        with pytest.raises(BadRequestError, match=said):
            list(one.path("al", POSES, op, **parameters))


def test_a_spent_budget_is_unknown_all_along_the_path(scene, client):
    for one in (scene, client):
        parts = list(one.path("al", POSES, budget_visits=0))
        verdicts = np.concatenate([part.verdict for part in parts])
        assert len(verdicts) == len(POSES) and Verdict.CLEAR not in verdicts[~clear_at_once(parts)]


@pytest.mark.parametrize(
    "op, parameters", [("collide", {}), ("distance", {"reach": 0.1}), ("contacts", {}), ("sweep", {})]
)
def test_what_the_time_did_not_suffice_for_is_unknown(scene, client, op, parameters):
    for one in (scene, client):
        parts = list(one.path("al", POSES, op, budget_ms=0.0, **parameters))
        verdicts = np.concatenate([part.verdict for part in parts])
        assert verdicts.tolist() == [Verdict.UNKNOWN] * (len(POSES) - (op == "sweep"))
        parts = list(one.path("al", POSES, op, budget_ms=60_000.0, **parameters))
        assert Verdict.UNKNOWN not in np.concatenate([part.verdict for part in parts])


def test_nothing_is_asked_once_the_time_is_up(scene, monkeypatch):
    def question(*_, **__):
        raise AssertionError("asked")

    for op in ("collide", "contacts", "sweep"):
        monkeypatch.setattr(path_module, op, question)
        assert {len(part) for part in scene.path("al", POSES, op, budget_ms=0.0)} <= {
            len(POSES),
            len(POSES) - 1,
        }


def clear_at_once(parts):
    """Which poses were clear without a visit: out of reach of every voxel."""
    visits = np.concatenate([part.node_visits for part in parts])
    bounds = np.concatenate([part.lower for part in parts])
    return (visits == 0) & (bounds > 0)


def compiled():
    """How many versions of each kernel there are; none where nothing is compiled."""
    found = {}
    for path in Path(kernels.__file__).parent.glob("*.py"):
        module = importlib.import_module(f"{kernels.__name__}.{path.stem}")
        for name, kernel in vars(module).items():
            if hasattr(kernel, "signatures"):
                found[path.stem, name] = len(kernel.signatures)
    return found


def test_who_asks_after_warming_waits_for_no_compiler(tmp_path):
    with Scene.open(cases.build(tmp_path, POINTS).archive) as scene:
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
            {"budget_visits": 9},
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
                scene.raycast(RAYS, TOWARDS, 1.5, **effort)
                scene.within(RAYS, 0.5, **effort)
                scene.objects([(name, poses[0]), ("bo", poses[0], 2)], **effort)
                list(scene.path(name, poses, "distance", reach=0.1, **effort))
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
