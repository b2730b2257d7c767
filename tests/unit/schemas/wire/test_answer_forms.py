"""Answers as one line of text and as values for JSON."""

import json
import math
from typing import Any

import numpy as np
import pytest
from count_within_question import COUNT_WITHIN
from msgspec import structs
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.path_messages import answers_to_part
from solidcloud.schemas.wire.question_table import (
    COLLIDE,
    CONTACTS,
    DISTANCE,
    OBJECTS,
    QUESTIONS,
    RAYCAST,
    SWEEP,
    WITHIN,
)

CLEAR, CONTACT, UNKNOWN = (int(verdict) for verdict in Verdict)


def answered(question: Any, verdicts: list[int], **columns: Any) -> Any:
    """Answers with these verdicts and columns."""
    none = question.unknown(len(verdicts))
    given = {name: np.array(value, getattr(none, name).dtype) for name, value in columns.items()}
    return structs.replace(none, verdict=np.array(verdicts, np.uint8), engine_seconds=3.1e-4, **given)


CONTACT_COLUMNS = {
    "pairs_found": [3, 0],
    "pair_starts": [0, 2, 2],
    "avatar_point": [[0, 0, 0], [1, 0, 0]],
    "cloud_point": [[0, 0, 1], [1, 0, 1]],
    "signed_distance": [-0.02, -0.01],
    "avatar_index": [0, 1],
    "scan_index": [0, -1],
    "cluster": [0, 0],
    "cluster_starts": [0, 1, 1],
    "cluster_count": [3],
    "cluster_deepest": [-0.02],
    "cluster_avatar": [[0, 0, 0]],
    "cluster_cloud": [[0, 0, 1]],
    "cluster_scan": [0],
    "cluster_low": [[0, 0, 1]],
    "cluster_high": [[1, 0, 1]],
}


@pytest.mark.parametrize(
    ("answers", "line"),
    [
        (answered(COLLIDE, [CLEAR] * 68 + [CONTACT] * 2), "70 poses: 68 clear, 2 contact, 0 unknown; 0.31 ms"),
        (answered(COLLIDE, [UNKNOWN]), "1 pose: 0 clear, 0 contact, 1 unknown; 0.31 ms"),
        (answered(DISTANCE, [CLEAR, CONTACT, CLEAR], signed_distance=[0.5, -0.0123456, math.inf]),
            "3 poses: 2 clear, 1 contact, 0 unknown; nearest -0.01235 m; 0.31 ms"),
        (answered(DISTANCE, [CLEAR]), "1 pose: 1 clear, 0 contact, 0 unknown; 0.31 ms"),
        (answered(CONTACTS, [CONTACT, CLEAR], **CONTACT_COLUMNS),
            "2 poses: 1 clear, 1 contact, 0 unknown; 3 pairs, 1 cluster, deepest -0.02 m; 0.31 ms"),
        (answered(SWEEP, [CONTACT, CLEAR], upper=[0.25, math.inf]),
            "2 motions: 1 clear, 1 contact, 0 unknown; earliest contact at 0.25 of a motion; 0.31 ms"),
        (answered(RAYCAST, [CONTACT], distance=[2.5]),
            "1 ray: 0 clear, 1 contact, 0 unknown; nearest hit at 2.5 m; 0.31 ms"),
        (answered(WITHIN, [CONTACT, CLEAR], distance=[0.125, math.inf]),
            "2 points: 1 clear, 1 contact, 0 unknown; nearest scan point at 0.125 m; 0.31 ms"),
        (answered(OBJECTS, [CLEAR] * 2, pair_verdict=[CONTACT]),
            "2 objects: 2 clear, 0 contact, 0 unknown; 1 pair touches; 0.31 ms"),
        (COLLIDE.unknown(0), "0 poses: 0 clear, 0 contact, 0 unknown"),
        (COUNT_WITHIN.unknown(2), "2 points: 0 clear, 0 contact, 2 unknown; not answered"),
        (answers_to_part(answered(COLLIDE, [CLEAR] * 2), 5, 100),
            "2 poses from 5 of 100: 2 clear, 0 contact, 0 unknown; 0.31 ms"),
        (structs.replace(COLLIDE.unknown(1), faults=("a", "b"), late=(7,), stopped="the client left"),
            "1 pose: 0 clear, 0 contact, 1 unknown; 2 unreadable voxels; 1 late voxel; stopped early"),
    ],
)  # fmt: skip
def test_an_answer_is_one_line(answers: Any, line: str) -> None:
    assert repr(answers) == str(answers) == line


@pytest.mark.parametrize("name", QUESTIONS)
def test_every_answer_becomes_json(name: str) -> None:
    question = QUESTIONS[name]
    values = question.unknown(3).to_dict()
    assert json.loads(json.dumps(values, allow_nan=False)) == values
    assert [row["verdict"] for row in values["answers"]] == ["unknown"] * 3
    scalar = {"engine_seconds", "hits", "misses", "resident", "resident_bytes", "wait_seconds"}
    assert scalar | {"faults", "late", "stopped"} <= set(values)
    if question.part is not None:
        part = answers_to_part(question.unknown(3), 1, 9).to_dict()
        assert (part["first"], part["total"], len(part["answers"])) == (1, 9, 3)


def test_contacts_are_listed_with_their_pose() -> None:
    first, second = answered(CONTACTS, [CONTACT, CLEAR], **CONTACT_COLUMNS).to_dict()["answers"]
    assert first["contacts"][1] == {
        "avatar_point": [1, 0, 0],
        "cloud_point": [1, 0, 1],
        "signed_distance": -0.01,
        "avatar_index": 1,
        "scan_index": -1,
        "cluster": 0,
    }
    assert first["clusters"][0] == {
        "count": 3,
        "deepest": -0.02,
        "avatar": [0, 0, 0],
        "cloud": [0, 0, 1],
        "scan": 0,
        "low": [0, 0, 1],
        "high": [1, 0, 1],
    }
    assert (first["pairs_found"], second["contacts"], second["clusters"]) == (3, [], [])


def test_what_is_not_finite_is_none() -> None:
    values = answered(
        DISTANCE, [CLEAR, CLEAR], signed_distance=[math.inf, 0.5], normal=[[math.nan] * 3, [0, 0, 1]]
    )
    first, second = values.to_dict()["answers"]
    assert (first["signed_distance"], first["normal"]) == (None, None)
    assert (second["signed_distance"], second["normal"]) == (0.5, [0, 0, 1])
