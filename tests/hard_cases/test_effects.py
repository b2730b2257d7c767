"""Hard case of what is not asked for; a test's number is its row in NUMERICS.md.

There are no effects yet. What can be asserted of them is: a scene declares none, and what a question does not need is
neither imported nor called, whatever else the scene holds.
"""

import json
import os
import subprocess
import sys
from pathlib import Path

import cases
import numpy as np
import pytest
import same_answers
import scans
from solidcloud.schemas.messages import MSGPACK, CollideRequest, encode
from solidcloud.server.app import Service
from solidcloud.server.config import ServerConfig
from solidcloud.server.scene import Scene

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"

ASK = """
import json, pathlib, sys
import numpy as np
from solidcloud.server.scene import Scene
with Scene.open(pathlib.Path(sys.argv[1])) as scene:
    scene.add_avatar("ball", np.zeros((1, 3)), 0.1)
    verdict = scene.collide("ball", np.eye(4)[None]).verdict.tolist()
    effects = scene.info().effects
print(json.dumps([verdict, effects, sorted(sys.modules)]))
"""


@pytest.mark.case(
    31,
    "(no effects yet) a scene opened and asked imports no report, maker, reader, transport, zenoh or plotting",
)
@pytest.mark.interpreted
def test_case_31_what_is_not_declared_is_not_imported(tmp_path: Path) -> None:
    case = cases.build(tmp_path, np.zeros((1, 3)), radius=0.1)
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", ASK, str(case.archive)],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"}, capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    verdict, effects, modules = json.loads(done.stdout)
    assert verdict == [1] and effects == []
    ours = {name.removeprefix("solidcloud.") for name in modules if name.startswith("solidcloud.")}
    assert {"server.scene", "server.collide"} <= ours
    for part in ("server.effects", "server.report", "server.app", "server.transport", "server.client", "server.cli",
                 "builder.made", "builder.sources", "builder.pipeline"):  # fmt: skip
        assert not [name for name in ours if name == part or name.startswith(part + ".")], part
    for library in (
        "zenoh",
        "matplotlib",
        "laspy",
        "pye57",
        "plyfile",
        "trimesh",
        "embreex",
        "typer",
        "rich",
    ):
        assert library not in modules


@pytest.mark.case(
    31,
    "(no effects yet) with other avatars, walkers and questions about, collide replies the same bytes at the same cost",
)
@pytest.mark.interpreted
def test_case_31_what_else_a_scene_holds_costs_a_question_nothing(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    case = cases.build(tmp_path, scans.make_scan(*same_answers.SCAN), leaf=8, cell_points=30)
    body, other = rng.uniform(-0.2, 0.2, (2, 20, 3))
    poses = cases.near_poses(rng, case.points, body, 6 if INTERPRETED else 60, 0.2)
    replies = []
    for declared in (False, True):
        with Scene.open(case.archive, "scene") as scene:
            if declared:
                for name in ("other", "third"):
                    scene.add_avatar(name, other, 0.02, client="c")
                scene.walker("other", client="c").collide(poses)
                scene.contacts("third", poses, 5, client="c")
                scene.objects([("other", pose) for pose in poses], client="c")
                scene.raycast(poses[:, :3, 3], poses[:, :3, 0], 1.0)
            scene.add_avatar("body", body, 0.01, client="c")
            found = scene.collide("body", poses, client="c")
            service = Service([scene], ServerConfig())
            payload = encode(CollideRequest("body", poses), MSGPACK)
            answer = service.answer("solidcloud/1/scene/scene/c/collide", payload, MSGPACK)
            assert answer.ok
        columns = (found.verdict, found.outside, found.node_visits, found.point_tests)
        replies.append(([column.tolist() for column in columns], len(answer.payload)))
    assert replies[0] == replies[1]
    assert sum(replies[0][0][2]) > 0
