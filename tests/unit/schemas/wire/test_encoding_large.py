"""Test the encoding of large messages, which are read in pieces."""

from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.wire.encoding import JSON, decode_request, encode
from solidcloud.schemas.wire.requests import AddAvatarRequest, CollideRequest


def test_large_messages_in_json_are_read_in_pieces_and_are_the_same():
    rng, k = np.random.default_rng(1), 5000
    poses = rng.normal(size=(k, 4, 4))
    text = encode(CollideRequest("al", poses), JSON)
    assert text == msgspec.json.encode(
        {"avatar": "al", "poses": poses.tolist(), "margin": 0.0, "budget_ms": None, "radius_model": None,
         "tolerance": 0.0}
    )  # fmt: skip
    text = text.replace(b"]", b" ] ").replace(b"[", b" [ ")
    found = decode_request(CollideRequest, text, JSON)
    assert found.poses.tobytes() == poses.tobytes() and found.poses.flags.writeable
    points = rng.normal(size=(4 * k, 3))
    text = encode(AddAvatarRequest("al", points), JSON)
    assert decode_request(AddAvatarRequest, text, JSON).points.tobytes() == points.tobytes()


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace(b"1.5", b"null", 1),
        lambda text: text.replace(b"1.5", b'"]],"', 1),
        lambda text: text.replace(b"1.5,", b"", 1),
        lambda text: text[:-200],
        lambda text: text.replace(b'"poses":[', b'"poses":7,"x":[', 1),
        lambda text: text.replace(b"1.5", b"1e999", 1),
        lambda text: text.replace(b"]],[[", b"],[", 1),
    ],
)
def test_large_malformed_json_is_bad_request(change):
    text = encode(CollideRequest("al", np.full((5000, 4, 4), 1.5)), JSON)
    with pytest.raises(BadRequestError):
        decode_request(CollideRequest, change(text), JSON)


@pytest.mark.parametrize(
    "value",
    [
        b"[[[" + b"0," * 400_000 + b"0]]]",  # one row
        b"[" + b"0," * 400_000 + b"0]",
        b"[" * 400 + b"0," * 400_000 + b"0" + b"]" * 400,
        b"[[[0]]" + b" " * 800_000 + b",[[0]]]",
        b'["' + b"x" * 800_000 + b'"]',
    ],
    ids=["one row", "numbers", "deep", "spaces", "text"],
)
def test_json_that_cannot_be_cut_is_refused_before_it_is_decoded(value, monkeypatch):
    decoded = []
    real = msgspec.json.Decoder(list)
    monkeypatch.setattr(
        "solidcloud.schemas.wire.encoding._LIST_DECODER",
        SimpleNamespace(decode=lambda text: decoded.append(len(text)) or real.decode(text)),
    )
    with pytest.raises(
        BadRequestError, match=r"no end of an element in 131072 bytes .* expected .* - at `\$\.poses`"
    ):
        decode_request(CollideRequest, b'{"avatar":"al","poses":%s}' % value, JSON)
    assert not decoded
