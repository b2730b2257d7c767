"""Hard case of what is not asked for; a test's number is its row in NUMERICS.md.

An effect that a scene does not declare is not imported, not called, and adds nothing to what is answered; what a scene
declares changes no question's answer, nor what it costs.
"""

import json
import os
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import archive_cases
import msgspec
import numpy as np
import pytest
import same_answers
import synthetic_scans
from solidcloud.schemas.scene.effect_table import ORDER
from solidcloud.schemas.scene.scene_file import SceneFile
from solidcloud.schemas.wire.encoding import MSGPACK, encode
from solidcloud.schemas.wire.requests import CollideRequest
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.simulation import make_simulation
from solidcloud.server.zenoh_server.request_dispatcher import RequestDispatcher
from solidcloud.server.zenoh_server.server_config import ServerConfig

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

# Each effect in the smallest scene that has it; `objects` is tested beside its own objects.
ALONE: dict[str, list[str]] = {
    "nothing": [],
    "stop": ["stop"],
    "sweep": ["stop", "sweep"],
    "slide": ["stop", "slide"],
    "ground": ["stop", "ground"],
    "step": ["stop", "slide", "ground", "step"],
    "proximity": ["proximity"],
    "contacts": ["contacts"],
    "uncertainty": ["uncertainty"],
    "objects": ["objects"],
    "crowd": ["stop", "crowd"],
}
# Files of effects, and the effects for which each is imported.
FILES = {
    "motion_effects": {"stop", "sweep", "slide", "ground", "step"},
    "report_effects": {"proximity", "contacts", "uncertainty"},
    "uncertainty_effect": {"uncertainty"},
    "body_effects": {"objects", "crowd"},
}
# Effects whose frames the kernel of walking runs; with `stop` too.
MOVING = {"sweep", "slide", "ground", "step", "crowd"}
# What only some effects have a use for, and which.
HELPERS = {
    "server.archives.masked_store": {"through"},
    "server.simulation.world.bodies": {"objects", "crowd"},
    "server.kernels.bodies.body_sweep": {"objects", "crowd"},
    "server.queries.surface_normals": {"slide", "ground", "step"},
    "server.simulation.world.walker": MOVING,
    "server.kernels.walk.walk_frame": MOVING,
    "server.kernels.rays.surface": MOVING,
}
# All that needs no objects of its own.
EVERY_EFFECT = msgspec.convert(
    {"format": 1, "archives": [{"path": "a"}], "limits": {"longest_move": 1000.0},
     "effects": [{"effect": name} for name in ORDER if name != "objects"]},
    SceneFile,
)  # fmt: skip
SAID = ("stepped", "ground", "proximity", "contacts", "uncertainty", "objects", "crowd")

# One process, that has what every scene has; each scene in a child of it, so that one imports nothing for another.
FRAMES = """
import json, os, pathlib, sys
import msgspec
import numpy as np
from solidcloud.schemas.wire.encoding import encode, JSON
from solidcloud.schemas.scene.scene_file import ArchiveItem, SceneFile
from solidcloud.server.simulation.world import collision_world as world
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.simulation import make_simulation
def child(names):
    effects = [{"effect": name} for name in names]
    file = msgspec.convert({"format": 1, "archives": [{"path": "a"}], "effects": effects}, SceneFile)
    with Scene.open(pathlib.Path(sys.argv[1])) as scene:
        simulation = make_simulation(scene, file)
        scene.add_avatar("ball", np.zeros((1, 3)), 0.1, client="c")
        pose = np.eye(4)[None]
        pose[0, 2, 3] = 0.3
        said = []
        for way in ([0.1, 0, 0], [0, 0, -0.5], [0.1, 0, -0.1]):
            wish = pose.copy()
            wish[0, :3, 3] += way
            moved = simulation.move("ball", pose, wish, client="c")
            pose = moved.pose
            said.append(json.loads(encode(moved, JSON)))
    ours = [m.removeprefix("solidcloud.") for m in sys.modules if m.startswith("solidcloud.")]
    return {"said": said, "modules": sorted(ours)}
found = {}
for key, names in json.loads(sys.argv[2]).items():
    reading, writing = os.pipe()
    if os.fork() == 0:
        with os.fdopen(writing, "w") as out:
            out.write(json.dumps(child(names)))
        os._exit(0)
    os.close(writing)
    with os.fdopen(reading) as out:
        found[key] = json.loads(out.read())
    os.wait()
print(json.dumps(found))
"""


@pytest.mark.case(
    31,
    "each effect alone: only its files and those of its requirements are imported, and only they report",
)
def test_case_31_of_all_effects_only_those_declared_are_imported_and_say_something(tmp_path: Path) -> None:
    floor = np.stack(np.meshgrid(np.arange(-3, 4), np.arange(-3, 4), [0]), axis=-1).reshape(-1, 3) * 0.1
    case = archive_cases.build(tmp_path, floor, radius=0.05)
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", FRAMES, str(case.archive), json.dumps(ALONE)],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"}, capture_output=True, text=True, check=True, timeout=240,
    )  # fmt: skip
    found = json.loads(done.stdout)
    for key, names in ALONE.items():
        modules, declared = set(found[key]["modules"]), set(names)
        loaded = {name for name in FILES if f"server.simulation.effects.{name}" in modules}
        assert loaded == {name for name, users in FILES.items() if users & declared}, (key, loaded)
        for module, users in HELPERS.items():
            assert module not in modules or users & declared, (key, module)
        for frame in found[key]["said"]:
            assert frame.get("simulated", []) == [name for name in ORDER if name in declared], key
            assert {name for name in SAID if name in frame} <= declared | {"stepped"} & (
                {"stepped"} if "step" in declared else set()
            ), key
    for name in ("proximity", "contacts", "uncertainty"):
        assert all(name in frame for frame in found[name]["said"])
    nothing = found["nothing"]["said"]
    assert all(frame.keys() <= {"pose", "verdict", "left", "unloaded"} for frame in nothing), (
        "where it is, and what it touches"
    )
    for frame, beside in zip(found["proximity"]["said"], nothing, strict=True):
        assert frame.pop("proximity") is not None and frame.pop("simulated") == ["proximity"]
        assert frame == beside


@pytest.mark.case(
    31,
    "a scene that is opened and queried imports no effect, report, generator, reader, transport, zenoh or plotting",
)
def test_case_31_what_is_not_declared_is_not_imported(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, np.zeros((1, 3)), radius=0.1)
    done = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", ASK, str(case.archive)],
        env=os.environ | {"NUMBA_DISABLE_JIT": "1"}, capture_output=True, text=True, check=True, timeout=120,
    )  # fmt: skip
    verdict, effects, modules = json.loads(done.stdout)
    assert verdict == [1] and effects == ["stop"], "that of a scene without a file, for who moves in it"
    ours = {name.removeprefix("solidcloud.") for name in modules if name.startswith("solidcloud.")}
    assert {"server.scene", "server.queries.collide"} <= ours
    # What a frame is made of, and their order, are types; nothing that would simulate one.
    assert not {name for name in ours if name.startswith("server.simulation.effects")}
    assert not {"server.simulation.world.collision_world", *HELPERS} & ours
    for part in ("server.report", "server.zenoh_server", "server.zenoh_common", "server.zenoh_client",
                 "server.client", "server.cli", "builder.synthetic", "builder.sources",
                 "builder.pipeline"):  # fmt: skip
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
    "beside other avatars, queries and all effects, collide replies the same bytes at the same cost",
)
def test_case_31_what_else_a_scene_holds_costs_a_question_nothing(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    case = archive_cases.build(
        tmp_path, synthetic_scans.make_scan(*same_answers.SCAN), leaf=8, cell_points=30
    )
    body, other = rng.uniform(-0.2, 0.2, (2, 20, 3))
    poses = archive_cases.near_poses(rng, case.points, body, 60, 0.2)
    replies = []
    for beside in ("nothing", "others", "effects"):
        with Scene.open(case.archive, "scene") as scene:
            if beside == "others":
                for name in ("other", "third"):
                    scene.add_avatar(name, other, 0.02, client="c")
                scene.collide("other", poses, client="c")
                scene.contacts("third", poses, 5, client="c")
                scene.objects([("other", pose) for pose in poses], client="c")
                scene.raycast(poses[:, :3, 3], poses[:, :3, 0], 1.0)
            if beside == "effects":
                scene._simulation = make_simulation(scene, EVERY_EFFECT)
                scene.add_avatar("other", other, 0.02, client="c")
                for pose, wish in pairwise(poses):
                    moved = scene.move("other", pose[None], wish[None], client="c")
                    assert moved.simulated == [name for name in ORDER if name != "objects"]
            scene.add_avatar("body", body, 0.01, client="c")
            found = scene.collide("body", poses, client="c")
            service = RequestDispatcher([scene], ServerConfig())
            payload = encode(CollideRequest("body", poses), MSGPACK)
            answer = service.answer("solidcloud/1/scene/scene/c/collide", payload, MSGPACK)
            assert answer.ok
        columns = (found.verdict, found.outside, found.node_visits, found.point_tests)
        replies.append(([column.tolist() for column in columns], len(answer.payload)))
    assert replies[0] == replies[1] == replies[2]
    assert sum(replies[0][0][2]) > 0
