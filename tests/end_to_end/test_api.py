"""Test `solidcloud.connect` in a separate process."""

import subprocess
import sys
from pathlib import Path

import trimesh
from floor import server_process

ASK = """
import sys
import numpy as np
import solidcloud
with solidcloud.connect(sys.argv[1], scene="floor") as scene:
    scene.add_avatar("al", np.zeros((1, 3)), 0.125)
    assert scene.add_avatar("box", sys.argv[2]).points > 1000
    assert repr(scene) == f"<Client of 'floor' at {sys.argv[1]}: open, avatars al, box>", repr(scene)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 2, 3] = 5.0, -5.0
    verdicts = scene.collide("al", poses).verdict.tolist()
    parts = [part.verdict.tolist() for part in scene.path("al", poses)]
    distances = scene.distance("al", poses, 1.0).verdict.tolist()
    with scene.session("al") as session:
        session.wish(poses[:1])
        assert repr(session).startswith("<Session of 'al' in 'floor': open, "), repr(session)
    assert scene.collide("al", poses).to_dict()["answers"][1]["verdict"] in ("clear", "contact")
    scene.stats()
print(verdicts, [name for name in ("numba", "llvmlite", "h5py") if name in sys.modules])
"""


def test_a_client_at_work_loads_neither_numba_nor_h5py(endpoint: str, tmp_path: Path) -> None:
    box = tmp_path / "box.stl"
    trimesh.creation.box((0.1, 0.1, 0.1)).export(box)
    with server_process(endpoint):
        done = subprocess.run(
            [sys.executable, "-P", "-c", ASK, endpoint, box],
            capture_output=True,
            text=True,
            check=False,
            timeout=60,
        )
    assert done.returncode == 0, done.stderr
    assert done.stdout.split()[-1] == "[]"
