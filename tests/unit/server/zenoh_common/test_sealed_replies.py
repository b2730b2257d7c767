"""Seals: whatever is not as it was sealed has another; the worked example of WIRE.md."""

import re
from pathlib import Path

import numpy as np
import pytest
import solidcloud.schemas
from solidcloud.schemas.wire.encoding import avatar_digest
from solidcloud.server.zenoh_common.sealed_replies import Sealer, hash_of

KEY, NONCE = bytes(range(32)), bytes(range(100, 116))
NAME = "solidcloud/1/scene/hall/c1/collide"
REQUEST, PAYLOAD = b"\x80", b"\x81\xa1a\x01"
POINTS = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1.75]])
ABOUT = avatar_digest(POINTS, 0.875)
MSGPACK = "application/msgpack"


def sealed(
    number=3,
    ok=True,
    encoding=MSGPACK,
    payload=PAYLOAD,
    about=ABOUT,
    key=KEY,
    nonce=NONCE,
    name=NAME,
    request=REQUEST,
):
    return Sealer(key, nonce, name, hash_of(request)).seal(number, ok, encoding, payload, about)


def number_of(seal, ok=True, encoding=MSGPACK, payload=PAYLOAD):
    return Sealer(KEY, NONCE, NAME, hash_of(REQUEST)).number_of(seal, ok, encoding, payload)


@pytest.mark.parametrize(
    "other",
    [
        {"ok": False},
        {"encoding": "application/json"},
        {"payload": PAYLOAD + b"\0"},
        {"key": bytes(32)},
        {"nonce": bytes(16)},
        {"name": NAME + "x"},
        {"request": b"\x81"},
        {"name": NAME[:-1]},
        {"number": 4, "ok": False},
        {"encoding": MSGPACK[:-1]},
    ],
)
def test_what_is_not_as_it_was_sealed_has_no_number(other):
    assert number_of(sealed(**other)) == -1


def test_the_example_of_the_document():
    text = (Path(solidcloud.schemas.__file__).parent / "WIRE.md").read_text(encoding="utf-8")
    section = text.split("## Seals\n", 1)[1].split("\n## ", 1)[0]
    found = dict(
        re.findall(
            r"^\| (key|nonce|key expression|request|number|encoding|payload|points|radius|about|seal) \| `([^`]*)` \|$",
            section,
            re.M,
        )
    )
    sealer = Sealer(
        bytes.fromhex(found["key"]),
        bytes.fromhex(found["nonce"]),
        found["key expression"],
        hash_of(bytes.fromhex(found["request"])),
    )
    points = np.array([float(text) for text in found["points"].split()]).reshape(-1, 3)
    about = avatar_digest(points, float(found["radius"]))
    assert hash_of(about).hex() == found["about"]
    seal = sealer.seal(int(found["number"]), True, found["encoding"], bytes.fromhex(found["payload"]), about)
    assert seal.hex() == found["seal"]
