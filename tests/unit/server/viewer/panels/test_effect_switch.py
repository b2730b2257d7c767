"""Test the effects of a scene as a message."""

import json
from types import SimpleNamespace
from typing import Any

import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.viewer.panels.effect_switch import NoSwitch, effects_message


def test_effects_that_run_and_that_can_be_switched_on() -> None:
    switch: Any = SimpleNamespace(declared=["stop", "slide", "sweep"])
    message = json.loads(effects_message(["stop", "newer"], switch))
    assert message["switchable"]
    assert [(each["name"], each["on"]) for each in message["effects"]] == [
        ("stop", True), ("sweep", False), ("slide", False), ("newer", True),
    ]  # fmt: skip
    stop, _, slide, newer = message["effects"]
    assert slide["needs"] == ["stop"] and stop["needs"] == []
    assert stop["meaning"].startswith("Contact blocks motion") and newer["meaning"] == ""


def test_effects_of_another_server_are_not_switched() -> None:
    assert not json.loads(effects_message(["stop"], NoSwitch()))["switchable"]
    with pytest.raises(BadRequestError, match="scene file"):
        NoSwitch().change(["stop"])
