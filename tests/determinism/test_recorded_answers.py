"""Test a sample of the recorded answers and sessions; `scripts/record_answers` compares all of them."""

from pathlib import Path

import pytest
from record_answers_cases.net import INPUTS, Net
from record_answers_cases.records import read

SESSIONS = {
    "through the door",
    "along the cloister",
    "a fall",
    "objects and a crowd",
    "through a box",
    "local radii",
    "in contact at first",
}


@pytest.mark.timeout(900)  # the first run may have to compile everything
def test_answers_and_sessions_are_the_recorded_ones(tmp_path: Path) -> None:
    recorded = read(INPUTS / "replies")
    net = Net(tmp_path, recorded)
    net.build("facade")
    assert net.contents["facade"] == recorded.archives["facade"], "the archive's points differ"
    sessions = [session for session in net.sessions(real=False) if session.name in SESSIONS]
    assert len(sessions) == len(SESSIONS)
    results = [*net.ask("facade"), *map(net.walk, sessions)]
    differ = [
        f"{each.group}, {each.passed}: {each.fields} {each.examples}" for each in results if each.different
    ]
    assert not differ, "\n".join(["record again with scripts/record_answers if this is meant", *differ])
