"""Requests of all kinds: what they refuse, made or read, and that they arrive as sent."""

import msgspec
import numpy as np
import pytest
from solidcloud.schemas.errors import BadRequestError, TooLargeError
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.schemas.wire.encoding import JSON, MSGPACK, decode_request, encode
from solidcloud.schemas.wire.path_messages import PathRequest
from solidcloud.schemas.wire.request_limits import MAX_OBJECTS
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
    check_avatar_name,
    make_objects,
)

POSES = np.tile(np.eye(4), (3, 1, 1))
VECTORS = np.arange(9.0).reshape(3, 3)
REQUESTS = [
    CollideRequest("al", POSES, 0.5, tolerance=0.1, budget_ms=2.5),
    DistanceRequest("al", POSES, 0.5),
    ContactsRequest("al", POSES, 5, 0.25, 0.125),
    SweepRequest(avatar="al", pose_from=POSES, pose_to=POSES + 1, margin=0.5),
    RaycastRequest(VECTORS, VECTORS + 1, 2.0),
    WithinRequest(VECTORS, 2.0),
    ObjectsRequest([ObjectEntry("al"), ObjectEntry("bo", 2, 2**32 - 2), ObjectEntry("al", 0, 0)], POSES, 0.5),
    PathRequest("al", POSES, "contacts", limit=5, margin=0.25, tolerance=0.5),
]
names = pytest.mark.parametrize("request_", REQUESTS, ids=lambda request: type(request).__name__)


def fields(request):
    return {name: getattr(request, name) for name in request.__struct_fields__}


@names
@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_requests_arrive_as_sent(request_, encoding):
    got = decode_request(type(request_), encode(request_, encoding), encoding)
    arrays = array_fields(type(request_))
    for name, value in fields(request_).items():
        found = getattr(got, name)
        if name in arrays:
            assert found.tobytes() == value.tobytes() and found.dtype == value.dtype
            assert found.flags.writeable and found.flags.c_contiguous
        else:
            assert found == value


@names
@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_no_request_holds_what_is_not_finite(request_, encoding):
    for name in array_fields(type(request_)):
        for bad in (np.nan, np.inf):
            array = getattr(request_, name).copy()
            array[1, 1] = bad
            payload = encode(msgspec.structs.replace(request_, **{name: array}), encoding)
            with pytest.raises(BadRequestError, match=name):
                decode_request(type(request_), payload, encoding)


BAD = {
    "tolerance": (-1e-9, np.inf, np.nan), "budget_ms": (-1.0, np.inf),
    "margin": (-1.0, np.nan), "reach": (-1.0, np.inf), "avatar": ("", "a" * 65), "limit": (-1, 10_001),
    "cluster_distance": (-1.0,), "op": ("raycast", "hop"),
}  # fmt: skip


@pytest.mark.parametrize(
    "request_, name, bad",
    [
        pytest.param(request_, name, bad, id=f"{type(request_).__name__}-{name}-{str(bad)[:9]}")
        for request_ in REQUESTS
        for name in BAD
        if name in request_.__struct_fields__
        for bad in BAD[name]
    ],
)
def test_figures_without_an_answer_are_bad_request(request_, name, bad):
    with pytest.raises(BadRequestError, match=name):
        type(request_)(**fields(request_) | {name: bad})
    raw = msgspec.msgpack.decode(encode(request_)) | {name: bad}
    with pytest.raises(BadRequestError, match=name):
        decode_request(type(request_), msgspec.msgpack.encode(raw))


@names
def test_fields_that_are_not_known_are_refused(request_):
    for encoding, coder in ((MSGPACK, msgspec.msgpack), (JSON, msgspec.json)):
        raw = coder.decode(encode(request_, encoding)) | {"mood": "good"}
        with pytest.raises(BadRequestError, match="mood"):
            decode_request(type(request_), coder.encode(raw), encoding)


@pytest.mark.parametrize("encoding", [MSGPACK, JSON])
def test_numbers_of_numpys_are_numbers(encoding):
    given = {"limit": np.int64(5), "margin": np.float32(0.25), "budget_ms": np.uint32(7)}
    got = decode_request(ContactsRequest, encode(ContactsRequest("al", POSES, **given), encoding), encoding)
    assert (got.limit, got.margin, got.budget_ms) == (5, 0.25, 7)
    with pytest.raises(BadRequestError, match=r"limit is 2\.5"):
        ContactsRequest("al", POSES, 2.5)


@pytest.mark.parametrize("name", ["", "a" * 65, 3, None, VECTORS])
def test_a_name_that_no_avatar_can_have_is_refused(name):
    with pytest.raises(BadRequestError, match=r"^avatar .*1 to 64"):
        check_avatar_name(name)
    if name is not None:  # which the server refuses, because null is no string
        with pytest.raises(BadRequestError, match=r"^avatar .*1 to 64"):
            AddAvatarRequest(name, VECTORS)
    check_avatar_name("a visitor")


@pytest.mark.parametrize(
    "kind, values",
    [
        (SweepRequest, {"avatar": "al", "pose_from": POSES, "pose_to": POSES[:2]}),
        (RaycastRequest, {"origins": VECTORS, "directions": VECTORS[:2], "reach": 1.0}),
        (ObjectsRequest, {"objects": [ObjectEntry("al")], "poses": POSES}),
    ],
)
def test_as_many_of_each_are_expected(kind, values):
    with pytest.raises(BadRequestError, match="equal numbers"):
        kind(**values)
    raw = {
        name: value.tobytes() if isinstance(value, np.ndarray) else value for name, value in values.items()
    }
    with pytest.raises(BadRequestError, match="equal numbers"):
        decode_request(kind, msgspec.msgpack.encode(raw))


def test_objects_as_they_are_given():
    items, poses = make_objects(
        [("al", POSES[0]), ("bo", POSES[1:2] * 2, np.uint32(4)), ("al", POSES[2].tolist(), 1, 6)]
    )
    assert items == [ObjectEntry("al"), ObjectEntry("bo", 4), ObjectEntry("al", 1, 6)]
    assert np.array_equal(poses, [POSES[0], POSES[1] * 2, POSES[2]])
    assert make_objects([])[1].shape == (0, 4, 4)


@pytest.mark.parametrize(
    "entry, said",
    [
        (("al",), "object 0 of 1 values"),
        (("al", POSES[0], 1, 2, 3), "object 0 of 5 values"),
        (("al", np.eye(3)), r"pose of object 0 of shape \(3, 3\): expected one pose, \(4, 4\)"),
        (("al", POSES[0], 1.5), "object 0: group or mask 1.5"),
        (("al", POSES[0], -1), "group"),
        (("al", POSES[0], 1, 2**32), "mask"),
        (("", POSES[0]), "avatar"),
    ],
)
def test_what_is_no_object_is_refused(entry, said):
    with pytest.raises(BadRequestError, match=said):
        make_objects([entry])


def test_too_many_objects_are_too_large():
    many = [ObjectEntry("al")] * (MAX_OBJECTS + 1)
    with pytest.raises(TooLargeError, match="2049 objects"):
        ObjectsRequest(many, np.zeros((MAX_OBJECTS + 1, 4, 4)))
    with pytest.raises(TooLargeError, match="2049 objects"):
        make_objects([("al", np.eye(4))] * (MAX_OBJECTS + 1))


@pytest.mark.parametrize(
    "values, said",
    [
        ({"op": "collide", "reach": 1.0}, "reach is not a parameter of collide"),
        ({"op": "sweep", "limit": 3}, "limit is not a parameter of sweep"),
        ({"op": "distance", "reach": 1.0, "margin": 0.0}, "margin is not a parameter"),
        ({"op": "contacts", "reach": 1.0}, "reach is not a parameter of contacts"),
    ],
)
def test_a_path_takes_what_its_question_takes(values, said):
    with pytest.raises(BadRequestError, match=said):
        PathRequest("al", POSES, **values)
    with pytest.raises(BadRequestError, match=said):
        decode_request(PathRequest, msgspec.msgpack.encode({"avatar": "al", "poses": b"", **values}))
