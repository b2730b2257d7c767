"""Test every query along a path: the parts equal the plain answers, bit for bit, here and over zenoh."""

import numpy as np
import pytest
import zenoh
from corner import POSES, same
from solidcloud.schemas.errors import BadRequestError, BadTransformError
from solidcloud.schemas.wire import key_expressions
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.encoding import JSON, MSGPACK, decode_answer, encode
from solidcloud.schemas.wire.path_messages import PathRequest, part_to_answers
from solidcloud.schemas.wire.question_table import QUESTIONS, join_answers
from solidcloud.server.queries import path as path_module
from solidcloud.server.zenoh_common.zenoh_settings import session_config


@pytest.mark.parametrize(
    "op, parameters",
    [
        ("collide", {}),
        ("collide", {"margin": 0.02, "tolerance": 0.01}),
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
        same(join_answers([part_to_answers(part) for part in parts]), expected)


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
@pytest.mark.parametrize("op, parameters", [("distance", {"reach": 0.05}), ("contacts", {}), ("sweep", {})])
def test_plain_zenoh_gets_the_parts_of_a_path(scene, endpoint, op, parameters, encoding, monkeypatch):
    monkeypatch.setattr(path_module, "FIRST_PART", 3)
    monkeypatch.setattr(path_module, "LARGEST_PART", 9)
    expected = list(scene.path("al", POSES, op, **parameters))
    key = key_expressions.query_key("hall", "plain", "path")
    payload = encode(PathRequest("al", POSES, op, **parameters), encoding)
    with zenoh.open(session_config(connect=endpoint)) as session:
        every = {"consolidation": zenoh.ConsolidationMode.NONE, "encoding": encoding}
        replies = [reply.ok.payload.to_bytes() for reply in session.get(key, payload=payload, **every)]
    assert len(replies) > 3
    parts = [decode_answer(QUESTIONS[op].part, reply, encoding) for reply in replies]
    same(
        join_answers([part_to_answers(part) for part in parts]),
        join_answers([part_to_answers(part) for part in expected]),
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
        ("collide", {"reach": 1.0}, "reach is not a parameter of collide"),
        ("distance", {"reech": 1.0}, "did you mean 'reach'"),
        ("distance", {"reach": 1.0, "limit": 3}, "limit is not a parameter of distance"),
        ("sweep", {"margin": -1.0}, "margin"),
        ("collide", {"tolerance": np.inf}, "tolerance"),
        ("contacts", {"limit": -1}, "limit"),
    ],
)
def test_parameters_that_do_not_fit_are_refused_by_both(scene, client, op, parameters, said):
    for one in (scene, client):
        with pytest.raises(BadRequestError, match=said):
            list(one.path("al", POSES, op, **parameters))


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
        monkeypatch.setitem(path_module.ENGINES, op, question)
        assert {len(part) for part in scene.path("al", POSES, op, budget_ms=0.0)} <= {
            len(POSES),
            len(POSES) - 1,
        }
