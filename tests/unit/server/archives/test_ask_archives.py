"""A path through several archives: what its parts share."""

from types import SimpleNamespace

import numpy as np
import pytest
from solidcloud.server.archives import ask_archives
from solidcloud.server.runtime.stop_flag import NO_STOP, StopFlag


@pytest.fixture
def flags(monkeypatch):
    """The flags that each archive was asked with, part by part; three archives of fakes."""
    asked = []

    def question(data, avatar, poses, op, parameters, stop):
        def ask(start, end, part=None):
            asked.append(part)
            return SimpleNamespace(node_visits=np.ones(end - start, np.int64))

        return ask, len(poses)

    monkeypatch.setattr(ask_archives, "path_question", question)
    monkeypatch.setattr(ask_archives, "answers_in_world", lambda found, *_: found)
    monkeypatch.setattr(ask_archives, "merge_answers", lambda answers: answers)
    monkeypatch.setattr(ask_archives, "join_answers", lambda answers: answers[0])
    return asked


def asked_along(stop, **parameters):
    legs = [ask_archives.PathLeg(None, None, 0, np.zeros((8, 4, 4))) for _ in range(3)]
    return ask_archives.ask_along(legs, None, "collide", parameters, stop)[0]


@pytest.mark.parametrize("parameters", [{}, {"budget_visits": 100}])
def test_all_archives_share_the_time_of_a_part(flags, parameters):
    ask = asked_along(StopFlag(part_seconds=30.0), **parameters)
    ask(0, 4)
    ask(4, 8)
    first, second = flags[0], flags[-1]
    assert first is not None and second is not None and first is not second
    assert [flag is first for flag in flags] == [True] * (len(flags) // 2) + [False] * (len(flags) // 2)
    assert len(flags) >= 6


def test_without_a_limit_each_archive_keeps_its_own_flag(flags):
    asked_along(NO_STOP)(0, 4)
    assert flags == [None] * 3
