"""Seals: whatever is not as it was sealed has another; the worked example of WIRE.md."""

import hashlib
import re
import struct
from pathlib import Path

import pytest
import solidcloud.schemas
from solidcloud.schemas.seals import Sealer, hash_of

KEY, NONCE = bytes(range(32)), bytes(range(100, 116))
NAME = "solidcloud/1/scene/hall/c1/collide"
REQUEST, PAYLOAD = b"\x80", b"\x81\xa1a\x01"
MSGPACK = "application/msgpack"


def sealed(
    number=3, ok=True, encoding=MSGPACK, payload=PAYLOAD, key=KEY, nonce=NONCE, name=NAME, request=REQUEST
):
    return Sealer(key, nonce, name, hash_of(request)).seal(number, ok, encoding, payload)


def number_of(seal, ok=True, encoding=MSGPACK, payload=PAYLOAD):
    return Sealer(KEY, NONCE, NAME, hash_of(REQUEST)).number_of(seal, ok, encoding, payload)


def test_a_seal_is_a_plain_keyed_hash():
    """As the document has it, without the code."""
    name, encoding = NAME.encode(), MSGPACK.encode()
    text = NONCE + hashlib.sha256(REQUEST).digest() + struct.pack("<QBQ", 3, 1, len(name)) + name
    text += hashlib.sha256(PAYLOAD).digest() + encoding
    assert sealed() == struct.pack("<Q", 3) + hashlib.blake2b(text, key=KEY, digest_size=32).digest()
    assert number_of(sealed()) == 3


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
            r"^\| (key|nonce|key expression|request|number|encoding|payload|seal) \| `([^`]*)` \|$",
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
    seal = sealer.seal(int(found["number"]), True, found["encoding"], bytes.fromhex(found["payload"]))
    assert seal.hex() == found["seal"]
