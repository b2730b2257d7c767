"""Test that WIRE.md states the version and the bytes that the code uses."""

import re
from pathlib import Path

import pytest
from solidcloud.schemas.wire import json_schemas, scene_messages
from solidcloud.schemas.wire.encoding import JSON, MSGPACK, decode_answer, decode_request, encode
from solidcloud.schemas.wire.requests import Request
from solidcloud.schemas.wire.scene_messages import ScenesAnswer

WIRE_MD = Path(scene_messages.__file__).parents[1] / "WIRE.md"


def worked_examples():
    text = WIRE_MD.read_text()
    found = re.findall(r"### (\w+)\n\n```json\n(.*?)\n```\n```hex\n(.*?)\n```", text, re.S)
    return [pytest.param(*example, id=example[0]) for example in found]


@pytest.mark.parametrize("name, text, digits", worked_examples())
def test_worked_example(name, text, digits):
    kind = {kind.__name__: kind for kind in json_schemas.MESSAGES}[name]
    decode = decode_request if issubclass(kind, Request) else decode_answer
    bits = bytes.fromhex(digits)
    for message in (decode(kind, text.encode(), JSON), decode(kind, bits, MSGPACK)):
        assert encode(message, JSON).decode() == text
        assert encode(message, MSGPACK) == bits


def test_wire_version_is_the_documents():
    first = WIRE_MD.read_text().splitlines()[0]
    assert first == f"# The wire, version {scene_messages.WIRE_VERSION}"
    assert ScenesAnswer([]).wire_version == scene_messages.WIRE_VERSION
