"""Test both encodings of the wire messages, and the refusal of malformed ones."""

import msgspec
import numpy as np
import pytest
from solidcloud.schemas.archive.pose_arrays import make_poses
from solidcloud.schemas.errors import BadRequestError, InternalError, TooLargeError
from solidcloud.schemas.wire import request_limits
from solidcloud.schemas.wire.answers import CollideAnswers, Verdict
from solidcloud.schemas.wire.encoding import (
    JSON,
    MSGPACK,
    decode_answer,
    decode_request,
    encode,
    wire_encoding,
)
from solidcloud.schemas.wire.question_table import check_answers
from solidcloud.schemas.wire.requests import AddAvatarRequest, CollideRequest, make_positions
from solidcloud.schemas.wire.scene_messages import AvatarInfo


def some_poses(k, seed=3):
    poses = np.tile(np.eye(4), (k, 1, 1))
    poses[:, :3, 3] = np.random.default_rng(seed).normal(size=(k, 3)) * 1e6
    return poses


def some_answers():
    return CollideAnswers(
        np.array([0, 1, 2], np.uint8),
        np.array([False, True, False]),
        np.array([0, 0, 2**32 - 1], np.uint32),
        np.array([1, 2, 3], np.uint32),
        np.array([4, 5, 6], np.uint32),
        engine_seconds=0.25,
        hits=3,
        faults=("voxel 7: checksum",),
    )


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
@pytest.mark.parametrize("k", [0, 1, 5])
def test_poses_arrive_bit_for_bit(encoding, k):
    poses = some_poses(k)
    request = decode_request(CollideRequest, encode(CollideRequest("al", poses, 0.1), encoding), encoding)
    assert (request.avatar, request.margin) == ("al", 0.1)
    assert request.poses.tobytes() == poses.tobytes()
    assert request.poses.shape == (k, 4, 4) and request.poses.dtype == np.float64
    assert request.poses.flags.writeable and request.poses.flags.c_contiguous


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_answers_arrive_as_sent(encoding):
    sent = some_answers()
    got = check_answers(decode_answer(CollideAnswers, encode(sent, encoding), encoding), 3)
    for name in ("verdict", "outside", "voxels_missing", "node_visits", "point_tests"):
        assert np.array_equal(getattr(got, name), getattr(sent, name))
        assert getattr(got, name).dtype == getattr(sent, name).dtype
    assert (got.engine_seconds, got.hits, got.faults) == (0.25, 3, ("voxel 7: checksum",))
    assert [answer.verdict for answer in got] == [Verdict.CLEAR, Verdict.CONTACT, Verdict.UNKNOWN]


def test_strided_and_big_endian_arrays_are_sent_right():
    poses = some_poses(4)[::2]
    swapped = make_poses(poses.astype(">f8"))
    for array in (make_poses(poses), swapped, poses.astype(">f8")):
        got = decode_request(CollideRequest, encode(CollideRequest("al", array)))
        assert np.array_equal(got.poses, poses)


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_non_finite_pose_is_bad_request(encoding, bad):
    poses = some_poses(3)
    poses[1, 2, 3] = bad
    if encoding == MSGPACK:
        payload = encode(CollideRequest("al", poses))
    else:
        text = str(poses.tolist()).replace("-inf", "-1e999").replace("inf", "1e999").replace("nan", "null")
        payload = b'{"avatar":"al","poses":%s}' % text.encode()
    with pytest.raises(BadRequestError, match="poses"):
        decode_request(CollideRequest, payload, encoding)


@pytest.mark.parametrize(
    "fields, word",
    [
        ({"avatar": "al", "poses": bytes(127)}, "multiple of 128"),
        ({"avatar": "al", "poses": [[1.0]]}, "bytes"),
        ({"avatar": "al", "poses": "text"}, "bytes"),
        ({"avatar": "al"}, "poses"),
        ({"avatar": "", "poses": b""}, "avatar"),
        ({"avatar": "a" * 65, "poses": b""}, "avatar"),
        ({"avatar": 3, "poses": b""}, "avatar"),
        ({"avatar": "al", "poses": b"", "reach": 1.0}, "reach"),
        ([], "object"),
    ],
)
def test_malformed_messagepack_is_bad_request(fields, word):
    with pytest.raises(BadRequestError, match=word):
        decode_request(CollideRequest, msgspec.msgpack.encode(fields))


@pytest.mark.parametrize(
    "poses",
    [
        "[[1,2],[3]]",
        "[1,2,3]",
        '[[["1"]]]',
        '"AAAA"',
        "[[[true]]]",
        "[null]",
        "{}",
        "[[[1,0,0,0],[0,1,0,0],[0,0,1,0]]]",
        "[[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,%s]]]" % ("9" * 400),
        "[" * 3000,
        "[[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]",
    ],
)
def test_malformed_json_is_bad_request(poses):
    with pytest.raises(BadRequestError):
        decode_request(CollideRequest, b'{"avatar":"al","poses":%s}' % poses.encode(), JSON)


def test_truncated_or_random_bytes_are_bad_request():
    whole = encode(CollideRequest("al", some_poses(1), 0.5))
    for length in range(len(whole)):
        with pytest.raises(BadRequestError):
            decode_request(CollideRequest, whole[:length])
    rng = np.random.default_rng(5)
    for _ in range(2000):
        flipped = bytearray(whole)
        flipped[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        try:
            request = decode_request(CollideRequest, bytes(flipped))
        except BadRequestError:
            continue
        assert request.poses.shape[1:] == (4, 4) and np.isfinite(request.poses).all()


def test_unknown_fields_are_refused_in_requests_and_ignored_in_answers():
    later = {"name": "al", "points": 3, "radius": 0.1, "bounding_radius": 1.0, "mood": "good"}
    for encoding, encoder in ((MSGPACK, msgspec.msgpack), (JSON, msgspec.json)):
        assert decode_answer(AvatarInfo, encoder.encode(later), encoding) == AvatarInfo("al", 3, 0.1, 1.0)
        with pytest.raises(BadRequestError, match="mood"):
            decode_request(AddAvatarRequest, encoder.encode({"name": "al", "mood": "good"}), encoding)
    columns = {
        name: b"\0" * size
        for name, size in zip(
            ("verdict", "outside", "voxels_missing", "node_visits", "point_tests"),
            (1, 1, 4, 4, 4),
            strict=True,
        )
    }
    got = decode_answer(CollideAnswers, msgspec.msgpack.encode(columns | {"mood": 1}))
    assert len(check_answers(got, 1)) == 1 and got.faults == ()


def test_answers_that_are_none_are_internal_errors_never_guesses():
    with pytest.raises(InternalError, match="expected 4"):
        check_answers(some_answers(), 4)
    answers = some_answers()
    answers.verdict[1] = 3
    with pytest.raises(InternalError, match="verdict 3"):
        check_answers(answers, 3)
    columns = {"verdict": b"\0", "outside": b"\2", "voxels_missing": bytes(4)}
    columns |= {"node_visits": bytes(4), "point_tests": bytes(4)}
    with pytest.raises(InternalError, match="outside"):
        decode_answer(CollideAnswers, msgspec.msgpack.encode(columns))
    with pytest.raises(InternalError):
        decode_answer(CollideAnswers, b"\xc1")


@pytest.mark.parametrize(
    "stated, expected",
    [
        (None, MSGPACK),
        ("", MSGPACK),
        ("zenoh/bytes", MSGPACK),
        ("application/msgpack", MSGPACK),
        ("application/json", JSON),
        ("application/json;charset=utf-8", JSON),
        ("Application/JSON", JSON),
    ],
)
def test_stated_encodings(stated, expected):
    assert wire_encoding(stated) == expected


@pytest.mark.parametrize("points", [[1.0, 2, 3], np.zeros((2, 4)), [["a", "b", "c"]], [[1, 2, np.nan]], None])
def test_points_that_are_none_are_refused_before_they_are_sent(points):
    with pytest.raises(BadRequestError):
        make_positions(points)


def test_too_many_points_are_refused_before_they_are_sent():
    with pytest.raises(TooLargeError, match="1000001"):
        make_positions(np.zeros((request_limits.MAX_AVATAR_POINTS + 1, 3)))


@pytest.mark.parametrize("poses", [np.eye(3), np.zeros((2, 3, 4)), np.zeros(16), "text", [[1, 2], [3]]])
def test_poses_of_the_wrong_shape_are_refused_before_they_are_sent(poses):
    with pytest.raises(BadRequestError):
        make_poses(poses)
