"""Test a server that answers `collide` while it compiles everything else, and its stop meanwhile."""

import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from floor import DEADLINE, PATH, POINTS, TRUTH, server_process
from solidcloud.schemas.errors import BusyError
from solidcloud.schemas.wire.warming_parts import PARTS
from solidcloud.server.client import Client


def test_a_server_answers_collide_while_the_rest_compiles(endpoint):
    with (
        server_process(endpoint, "--walked", "--never-warm", "motion", last_line="warming motion") as process,
        Client(endpoint, scene="floor", timeout=DEADLINE) as client,
    ):
        client.add_avatar("al", POINTS, 0.125)
        assert np.array_equal(client.collide("al", PATH).verdict, TRUTH)
        assert client.info().compiling == client.stats().compiling == list(PARTS[1:])
        for part, ask in {
            "distance": lambda: client.distance("al", PATH),
            "sweep": lambda: list(client.path("al", PATH, "sweep")),
            "motion": lambda: client.move("al", PATH[0], PATH[1], 0.1),
        }.items():
            with pytest.raises(BusyError, match=f"({part}) not ready: this server compiles"):
                ask()
        assert client.info().compiling[0] == "motion"
        with client.session("al") as walker:
            number = walker.wish(pose=PATH[0])
            with pytest.raises(BusyError, match="motion not ready"):
                walker.wait(number, DEADLINE)
        process.send_signal(signal.SIGTERM)
        assert process.wait(DEADLINE) == 0


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_server_stops_before_it_can_answer(endpoint, number):
    command = [sys.executable, str(Path(__file__).parent / "fake_server.py"), endpoint]
    with subprocess.Popen(
        [*command, "--never-warm", "collide"], stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout.readline() == "warming collide\n"
            process.send_signal(number)
            assert process.wait(DEADLINE) == 0 and process.stdout.read() == ""
        finally:
            process.kill()
