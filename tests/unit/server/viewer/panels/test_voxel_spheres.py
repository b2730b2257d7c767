"""Test the spheres near a user as a message: places, budget, depth."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from page_arrays import decoded
from solidcloud.schemas.wire.tile_messages import MAX_SPHERE_LEVEL, TileAnswer, VoxelsAnswer
from solidcloud.server.viewer.page.view_frame import ViewFrame
from solidcloud.server.viewer.panels.voxel_spheres import SphereSource

DEPTH = 3


class Reader:
    """Scene of two voxels, whose hierarchy has 4 children a node, and DEPTH levels below the root."""

    def __init__(self) -> None:
        self.asked: list[int] = []

    def voxels(self, place: Any, reach: float | None = None, limit: int = 4096) -> VoxelsAnswer:
        count = 0 if reach is not None and np.linalg.norm(place) > 50 else 2
        low = np.array([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]])[:count]
        return VoxelsAnswer(
            total=2,
            archive=np.zeros(count, np.uint16),
            voxel=np.array([[0, 0, 0], [1, 0, 0]], np.int32)[:count],
            low=low,
            high=low + 2,
            points=np.full(count, 64, np.uint64),
            bytes=np.ones(count, np.uint64),
            resident=np.zeros(count, bool),
            poses=np.eye(4)[None],
            edges=np.array([2.0]),
        )

    def tile(self, archive: int, voxel: list[int], level: int = 0) -> TileAnswer:
        self.asked.append(level)
        count = 4 ** min(level, DEPTH)
        pose = np.eye(4)
        pose[0, 3] = 2.0 * voxel[0]
        places = np.zeros((count, 3), np.uint16)
        places[:, 0] = np.arange(count)
        none = np.empty(0)
        radii = np.arange(count, dtype=np.uint16)[::-1]
        return TileAnswer(
            pose[None], 0.01, 64, 0.004, places, radii, none.astype("u1"), none, none.astype("u1"), none
        )


def scene_of(reader: Reader) -> Any:
    frame = ViewFrame([[0, 0, 0], [4, 2, 2]])
    return SimpleNamespace(info=SimpleNamespace(generation=0), reader=reader, frame=frame)


def test_spheres_of_a_level_are_in_the_frame_of_the_page() -> None:
    reader = Reader()
    source, scene = SphereSource(), scene_of(reader)
    header, arrays = decoded(source.message(scene, (0.0, 0.0, 0.0), 1))
    assert (header["level"], header["depth"], header["total"], header["points"]) == (1, DEPTH, 8, 128)
    assert header["radii"] == [0.0, 0.03]
    assert np.allclose(arrays["low"][0], -scene.frame.origin)
    # Large spheres first; a sphere of radius 0 is drawn with the radius of a point.
    assert np.allclose(arrays["radius"], [0.03, 0.03, 0.02, 0.02, 0.01, 0.01, 0.004, 0.004])
    assert np.allclose(arrays["center"][1], np.array([2.0, 0.0, 0.0]) - scene.frame.origin)
    assert MAX_SPHERE_LEVEL in reader.asked
    reader.asked.clear()
    source.message(scene, (0.0, 0.0, 0.0), 2)
    assert reader.asked == [2, 2], "the depth of each voxel is known"
