"""Answers to fixed queries of an archive, as text. Another process must print the same.

python same_answers.py ARCHIVE
"""

import json
import sys
from pathlib import Path

import archive_cases
import numpy as np
import synthetic_scans
from solidcloud.server.kernels.core.placed_avatar import place, to_units
from solidcloud.server.scene import Scene

SCAN = ("corner", 21, 150)


def answers(archive: Path) -> str:
    """Return the verdicts and costs of 60 poses, and the placed integers of all their avatar points."""
    rng = np.random.default_rng(12)
    avatar = rng.uniform(-0.2, 0.2, (40, 3))
    poses = archive_cases.near_poses(rng, synthetic_scans.make_scan(*SCAN), avatar, 60, 0.2)
    with Scene.open(archive) as scene:
        scene.add_avatar("avatar", avatar)
        radius = scene.add_avatar("avatar", avatar).radius
        origin = scene.info().origin
        found = scene.collide("avatar", poses, 0.01)
    placed = [
        int(to_units(place(pose, pose[:3, 3] - origin, r, *point)))
        for pose in poses
        for point in avatar
        for r in range(3)
    ]
    columns = (found.verdict, found.outside, found.voxels_missing, found.node_visits, found.point_tests)
    return json.dumps({"radius": radius.hex(), "placed": placed, "columns": [c.tolist() for c in columns]})


if __name__ == "__main__":
    print(answers(Path(sys.argv[1])))
