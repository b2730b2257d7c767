"""Test rogue sessions at the server's port: others receive no false answer and lose nothing."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from fake_server import floor_simulation
from floor import eventually
from rogue_cases.rogue_attacks import AVATAR, DEADLINE, MODES, POINTS, TOOLS, Rogue, Victim, attempt, widths
from solidcloud.server.client import Client
from solidcloud.server.scene_interface import EVERYBODY
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig
from walkers import pose_at

SCRIPTS = Path(__file__).parents[2] / "scripts"


@pytest.fixture(scope="module")
def endpoint(free_endpoint):
    return free_endpoint()


@pytest.fixture(scope="module")
def victim(endpoint):
    """Return a client with an avatar and a session, of a server that rogues can reach."""
    with (
        serving([floor_simulation().scene], ServerConfig(listen=endpoint)),
        Client(endpoint, scene="floor", timeout=DEADLINE) as client,
    ):
        client.add_avatar(AVATAR, POINTS, 0.125)
        with client.session(AVATAR) as session:
            session.wait(session.wish(pose_at(0.0, 1.0)), DEADLINE)
            yield Victim(client, session, client._connection.client_id)


@pytest.fixture(scope="module", params=MODES)
def rogue(request, endpoint, victim):
    with Rogue(endpoint, request.param) as rogue:
        yield rogue


@pytest.mark.parametrize("tool", TOOLS)
def test_no_tool_of_a_rogue_has_a_success(rogue, victim, tool):
    found = {}
    for width in widths("floor", victim.id):
        if said := attempt(tool, rogue, width, victim):
            found[width] = said
    assert not found


def test_a_rogue_is_not_gossiped_to_clients(rogue, victim):
    session = victim.client._connection.session
    assert len(list(session.info.peers_zid())) + len(list(session.info.routers_zid())) == 1


def test_a_token_of_everybody_leaves_the_scenes_own_avatars(free_endpoint):
    """Test a token of the client "*", which owns the scene's avatars and is no valid client name."""
    endpoint, floor = free_endpoint(), floor_simulation()
    floor.scene.add_avatar("own", POINTS, 0.125, client=EVERYBODY)
    with serving([floor.scene], ServerConfig(listen=endpoint)), Rogue(endpoint, "client") as rogue:
        gone = len(floor.scene.gone)
        for key in ("solidcloud/1/client/floor/*", "solidcloud/1/client/floor/last"):
            rogue.session.liveliness().declare_token(key).undeclare()
            rogue.settle()
        eventually(lambda: "last" in floor.scene.gone)  # after the others on one channel
        assert floor.scene.gone[gone:] == ["last"] and floor.scene.avatar("own", "anybody")


def test_few_attacks_by_the_script_have_no_success():
    """Test a few attacks by scripts/attack_wire in a separate process."""
    done = subprocess.run(
        [sys.executable, SCRIPTS / "attack_wire", "--attempts", "36"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["successes"] == 0
