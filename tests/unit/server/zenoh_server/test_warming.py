"""Test the warming of a server's scenes: what is refused meanwhile, and in which order."""

from collections.abc import Callable

import pytest
from solidcloud.schemas.errors import BusyError, CorruptError
from solidcloud.schemas.wire.warming_parts import PARTS
from solidcloud.server.zenoh_server.warming import Warming

REST = list(PARTS[1:])


class WarmedScene:
    """Scene that notes what is warmed, and does something before a part."""

    simulation = None

    def __init__(self, name: str, before: dict[str, Callable[[], object]] | None = None) -> None:
        self.name, self.parts, self.before = name, [], before or {}

    def warm(self, *parts: str) -> None:
        for part in parts:
            self.before.get(part, lambda: None)()
            self.parts.append(part)


def made(*scenes: WarmedScene, compiles: bool = True) -> Warming:
    return Warming(scenes, lambda: compiles)


def test_each_part_of_every_scene_is_warmed_once_collide_first():
    first, second = WarmedScene("hall"), WarmedScene("yard")
    made(first, second).run()
    assert first.parts == second.parts == list(PARTS) and PARTS[0] == "collide"


def test_what_is_not_ready_is_refused_with_its_reason():
    warming = made(WarmedScene("hall"))
    warming.check(*PARTS)  # nothing is refused before it begins, nor after it
    warming.run_first()
    assert warming.compiling == REST
    warming.check("collide")
    with pytest.raises(BusyError, match=r"^distance not ready: this server compiles .* 7 of 8 .* again"):
        warming.check("distance")
    assert warming.run_rest() and warming.compiling == []
    warming.check(*PARTS)


def test_nothing_is_refused_where_nothing_is_compiled():
    warming = made(WarmedScene("hall"), compiles=False)
    warming.run_first()
    warming.check(*PARTS)
    assert warming.compiling == []


def test_a_part_that_cannot_be_warmed_is_not_refused_for_ever(caplog):
    def fails():
        raise CorruptError("record 7")

    warming = made(WarmedScene("hall", {"distance": fails}))
    warming.run_first()
    assert warming.run_rest() and warming.compiling == []
    assert "cannot warm distance" in caplog.text and "record 7" in caplog.text
    with pytest.raises(CorruptError, match="record 7"):
        made(WarmedScene("hall", {"collide": fails})).run_first()
