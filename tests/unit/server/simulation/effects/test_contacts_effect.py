"""`contacts`, the effect: its clusters are those of the question; where nothing is near, that question is not asked."""

from pathlib import Path

import archive_cases
import numpy as np
import pytest
import synthetic_scans
from effect_frames import body_of, flip_a_byte, report, world_of
from numpy.typing import NDArray
from solidcloud.schemas.scene.effect_table import Contacts
from solidcloud.schemas.wire.motion_messages import ContactsReport
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.effects import report_effects as contacts

BALL = make_avatar([[0.0, 0, 0]], 0.1)
ROW = np.column_stack([np.arange(0, 4, 0.1), np.zeros(40), np.zeros(40)])


def at(x: float, y: float, z: float) -> NDArray[np.float64]:
    """The ball there."""
    return archive_cases.pose_of(np.eye(3), np.array([x, y, z]))


@pytest.mark.interpreted
def test_clusters_are_those_of_the_question(tmp_path: Path, rng: np.random.Generator) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("corner", 3, 150), voxel=0.5)
    avatar = make_avatar(rng.uniform(-0.3, 0.3, (30, 3)), 0.02)
    cut = touched = 0
    with Scene.open(case.archive, "scene") as scene:
        scene.add_avatar("avatar", avatar.points, avatar.radius)
        world = world_of(scene)
        for pose in archive_cases.near_poses(rng, case.points, avatar.points, 12, 0.15):
            for margin, limit, distance in ((0.0, 2, None), (0.05, 16, None), (0.05, 3, 0.001)):
                runner = contacts.make(Contacts(margin=margin, limit=limit, cluster_distance=distance), None)
                found = report(runner, world, body_of(avatar), pose)
                asked = scene.contacts("avatar", pose[None], 1000, margin, distance)
                assert found.total == len(asked.cluster_count) and not found.unknown
                assert [c.count for c in found.clusters] == asked.cluster_count[:limit].tolist()
                assert [c.deepest for c in found.clusters] == asked.cluster_deepest[:limit].tolist()
                assert [c.avatar for c in found.clusters] == list(
                    map(tuple, asked.cluster_avatar[:limit].tolist())
                )
                assert [c.cloud for c in found.clusters] == list(
                    map(tuple, asked.cluster_cloud[:limit].tolist())
                )
                touched += found.total > 0
                cut += found.total > len(found.clusters)
    assert cut > 2 and 10 < touched < 36


@pytest.mark.interpreted
def test_what_could_not_be_read_is_unknown(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, ROW, voxel=1.0, resolution=1e-3)
    flip_a_byte(case.archive, (1, 0, 0))
    runner, body = contacts.make(Contacts(margin=0.01), None), body_of(BALL)
    with Scene.open(case.archive, "scene") as scene:
        world = world_of(scene)
        assert report(runner, world, body, at(1.5, 0, 0.05)) == ContactsReport(unknown=True)
        half = report(runner, world, body, at(1.0, 0, 0.05))
        assert half.unknown and half.total == 1, "what is known of is reported"
        assert report(runner, world, body, at(2.5, 0, 0.05)).unknown is False
        # The index says that all of the voxel's points lie at z = 0.
        assert report(runner, world, body, at(1.5, 0, 0.5)) == ContactsReport()
