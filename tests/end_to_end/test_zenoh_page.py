"""Test the page that is a client by itself (scripts/zenoh_page), as far as it can be without a bridge.

Its messages pass between Node.js and this project's own encoder and decoder, in both directions, and
its requests are sent to a server by a zenoh session in the mode in which the bridge runs.
"""

import json
import shutil
import subprocess
import threading
from collections.abc import Iterator
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zenoh
from fake_server import FloorScene, floor_verdicts
from solidcloud.schemas.wire.answers import CollideAnswers
from solidcloud.schemas.wire.encoding import JSON, decode_request, encode
from solidcloud.schemas.wire.key_expressions import client_token_key, query_key
from solidcloud.schemas.wire.requests import AddAvatarRequest, CollideRequest
from solidcloud.schemas.wire.scene_messages import AvatarInfo, ErrorReply
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig
from viewed_page import needs_chromium

PAGE = Path(__file__).resolve().parents[2] / "scripts" / "zenoh_page"
NODE, NPM = shutil.which("node"), shutil.which("npm")
node_only = pytest.mark.skipif(NODE is None, reason="no node in PATH: apt-get install nodejs")
installed_only = pytest.mark.skipif(
    NODE is None or NPM is None or not (PAGE / "node_modules").is_dir(),
    reason="the page's packages are not installed: npm ci in scripts/zenoh_page",
)


def node(program: str, **values: Any) -> Any:
    """Return the result of a program that has the page's messages as `wire` and `values`."""
    module = (PAGE / "src" / "wire.js").as_uri()
    text = (
        f"import * as wire from {json.dumps(module)};"
        f"const values = {json.dumps(values)};"
        f"console.log(JSON.stringify((() => {{ {program} }})() ?? null));"
    )
    done = subprocess.run(
        [str(NODE), "--input-type=module"], input=text, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@node_only
def test_project_reads_the_pages_requests(rng: np.random.Generator) -> None:
    place, turn = rng.normal(size=3) * 1e6, 33.0
    added, asked = node(
        "return [wire.addAvatarRequest('figure', wire.columnPoints(1.75, 0.25), 0.25),"
        " wire.collideRequest('figure', [wire.uprightPose(values.place, values.turn)], 0.5)];",
        place=place.tolist(),
        turn=turn,
    )
    avatar = decode_request(AddAvatarRequest, added.encode(), JSON)
    assert (avatar.name, avatar.radius) == ("figure", 0.25)
    # Its spheres reach from the feet to the top, without gaps.
    heights = avatar.points[:, 2]
    assert (heights[0], heights[-1]) == (0.25, 1.5)
    assert (np.diff(heights) <= 0.25 + 1e-12).all()
    request = decode_request(CollideRequest, asked.encode(), JSON)
    assert (request.avatar, request.margin) == ("figure", 0.5)
    c, s = np.cos(np.radians(turn)), np.sin(np.radians(turn))
    assert np.array_equal(request.poses[0, :3, 3], place)
    assert np.allclose(request.poses[0, :3, :3], [[c, -s, 0], [s, c, 0], [0, 0, 1]], atol=1e-15)
    assert np.array_equal(request.poses[0, 3], [0, 0, 0, 1])


@node_only
def test_page_reads_the_projects_answers() -> None:
    answers = CollideAnswers(
        verdict=np.array([0, 1, 2], np.uint8),
        outside=np.array([False, True, False]),
        voxels_missing=np.array([0, 0, 4], np.uint32),
        node_visits=np.array([7, 8, 9], np.uint32),
        point_tests=np.array([1, 2, 3], np.uint32),
        lower=np.array([-np.inf, 0.0, np.nan]),
        upper=np.array([np.inf, 0.0, np.nan]),
        exact=np.array([True, True, False]),
        engine_seconds=0.25,
        faults=["voxel 3: damaged"],
    )
    found = node(
        "return [wire.readCollideAnswers(values.answers, 3), wire.readAvatarInfo(values.avatar),"
        " wire.readError(values.encoding, values.error).code, wire.readError('zenoh/bytes', 'Timeout').code];",
        answers=encode(answers, JSON).decode(),
        avatar=encode(AvatarInfo("figure", 6, 0.25, 1.75), JSON).decode(),
        encoding=f"{JSON};{'0' * 144}",
        error=encode(ErrorReply("busy", "later"), JSON).decode(),
    )
    assert found[0] == {
        "verdict": ["clear", "contact", "unknown"],
        "outside": [False, True, False],
        "voxelsMissing": [0, 0, 4],
        "nodeVisits": [7, 8, 9],
        "pointTests": [1, 2, 3],
        "engineSeconds": 0.25,
        "faults": ["voxel 3: damaged"],
    }
    assert found[1] == {
        "name": "figure",
        "points": 6,
        "radius": 0.25,
        "bounding_radius": 1.75,
        "inner_points": 0,
        "description": "",
    }
    assert found[2:] == ["busy", "zenoh"]


@node_only
@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("wire.readCollideAnswers(values.wrong, 1)", "verdict 3"),
        ("wire.readCollideAnswers(values.wrong, 2)", "one for each of 2 poses"),
        ("wire.collideRequest('figure', [wire.uprightPose([NaN, 0, 0], 0)])", "finite"),
        ("wire.questionKey('a/b', 'c', 'info')", "a/b"),
        ("wire.tokenKey('*', 'c')", "*"),
    ],
)
def test_page_refuses_what_the_wire_forbids(call: str, message: str) -> None:
    zeros = {name: [0] for name in ("outside", "voxels_missing", "node_visits", "point_tests")}
    said = node(
        f"try {{ {call}; return null; }} catch (error) {{ return error.message; }}",
        wrong=json.dumps({"verdict": [3], **zeros}),
    )
    assert said is not None and message in said


@node_only
def test_server_answers_the_pages_requests(endpoint: str) -> None:
    places = [[0.0, 0.0, height] for height in (-1.0, 0.5)]
    client, keys, token, added, asked, points = node(
        "const client = wire.newClient(), points = wire.columnPoints(1.75, 0.25);"
        "return [client, ['info', 'add_avatar', 'collide'].map((each) => wire.questionKey('floor', client, each)),"
        " wire.tokenKey('floor', client), wire.addAvatarRequest('figure', points, 0.25),"
        " wire.collideRequest('figure', values.places.map((place) => wire.uprightPose(place, 90))), points];",
        places=places,
    )
    assert len(client) == 32
    assert keys == [query_key("floor", client, name) for name in ("info", "add_avatar", "collide")]
    assert token == client_token_key("floor", client)
    config = zenoh.Config()
    config.insert_json5("mode", '"client"')
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with serving([FloorScene()], ServerConfig(listen=endpoint)), zenoh.open(config) as session:
        declared = session.liveliness().declare_token(token)
        replies = []
        for key, payload in zip(keys, (None, added, asked), strict=True):
            (reply,) = session.get(key, payload=payload, encoding=JSON, timeout=20.0)
            assert reply.ok is not None
            replies.append(reply.ok.payload.to_string())
        declared.undeclare()
    info, avatar, answers = node(
        "return [wire.readSceneInfo(values.replies[0]), wire.readAvatarInfo(values.replies[1]),"
        " wire.readCollideAnswers(values.replies[2], 2)];",
        replies=replies,
    )
    assert info["scene"] == "floor"
    assert avatar["points"] == len(points)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, :3, 3] = places
    expected = floor_verdicts(np.array(points), 0.25, poses)
    assert set(expected) == {0, 1}
    assert answers["verdict"] == [("clear", "contact", "unknown")[code] for code in expected]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the page; return its folder."""
    folder = tmp_path_factory.mktemp("zenoh_page")
    subprocess.run([str(NODE), "build.mjs", str(folder)], cwd=PAGE, check=True)
    return folder


@installed_only
def test_page_passes_the_type_check() -> None:
    done = subprocess.run(
        [str(NPM), "run", "--silent", "check"], cwd=PAGE, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout


@pytest.fixture
def address(built: Path) -> Iterator[str]:
    """Serve the built page; yield its address."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *arguments: Any) -> None:
            """Write nothing."""

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=str(built))) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


@installed_only
@needs_chromium
def test_built_page_starts_and_says_that_no_bridge_answers(
    browser: Any, address: str, free_endpoint: Any
) -> None:
    where = f"ws://127.0.0.1:{free_endpoint().rpartition(':')[2]}"
    page = browser.new_page()
    failures: list[str] = []
    page.on("pageerror", lambda error: failures.append(str(error)))
    page.goto(address)
    page.get_by_label("Bridge").fill(where)
    page.get_by_role("button", name="Connect").click()
    page.get_by_text(f"Nothing answers at {where}: start the bridge.").wait_for()
    assert page.inner_text("#verdict") == "unknown"
    assert page.get_by_role("button", name="Collide").is_disabled()
    assert failures == []
    page.close()
