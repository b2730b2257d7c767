"""Seals: whatever is not as it was sealed has another; the worked example of WIRE.md."""

import hashlib
import re
import struct
from pathlib import Path

import numpy as np
import pytest
import solidcloud.schemas
from solidcloud.schemas.wire.encoding import avatar_digest
from solidcloud.server.zenoh_common.sealed_replies import Sealer, hash_of, is_about

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


def test_a_seal_is_a_plain_keyed_hash():
    """As the document has it, without the code."""
    name, encoding = NAME.encode(), MSGPACK.encode()
    text = NONCE + hashlib.sha256(REQUEST).digest() + struct.pack("<QBQ", 3, 1, len(name)) + name
    about = hashlib.sha256(ABOUT).digest()
    text += hashlib.sha256(PAYLOAD).digest() + about + encoding
    assert sealed() == struct.pack("<Q", 3) + about + hashlib.blake2b(text, key=KEY, digest_size=32).digest()
    assert number_of(sealed()) == 3


def test_a_seal_says_which_avatars_a_reply_is_about():
    other = avatar_digest(POINTS, 0.5)
    assert number_of(sealed(about=other)) == 3, "the seal is right"
    for about in (b"", ABOUT, other, ABOUT + other, other + ABOUT, ABOUT + ABOUT):
        seal = sealed(about=about)
        assert is_about(seal, about) and number_of(seal) == 3
        assert not [each for each in (b"", ABOUT, other) if each != about and is_about(seal, each)]


def test_an_avatars_digest_is_of_its_numbers():
    numbers = struct.pack("<8d", 0, 0, 0, 0, 0, 1.75, 0.875, 0)
    assert hashlib.sha256(numbers).digest() == ABOUT
    assert avatar_digest(np.asfortranarray(-POINTS * -1.0), 0.875) == ABOUT
    assert avatar_digest(POINTS * [1.0, -1.0, 1.0], 0.875) == ABOUT, "a zero has no sign"
    assert avatar_digest(np.empty((0, 3)), -0.0) == hashlib.sha256(bytes(16)).digest()
    assert ABOUT not in (avatar_digest(POINTS[::-1], 0.875), avatar_digest(POINTS, np.nextafter(0.875, 1)))
    assert avatar_digest(POINTS, 0.875, 1) != ABOUT, "a point inside is no part of the surface"


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


def test_a_seal_that_is_damaged_has_no_number():
    seal = sealed()
    for at in range(len(seal)):
        assert number_of(seal[:at] + bytes([seal[at] ^ 1]) + seal[at + 1 :]) == -1
    assert number_of(seal[:-1]) == number_of(b"") == number_of(seal + b"\0") == -1


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
