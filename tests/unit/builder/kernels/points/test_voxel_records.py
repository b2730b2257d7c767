"""Compare points read from a record's bytes with decoded ones, and test the check of a record's bounds."""

import os

import numpy as np
import pytest
from opened_records import open_points, open_scan, points_of
from solidcloud.builder.kernels.points.voxel_records import (
    last_unenclosing_node,
    measure_points,
    point_hash,
    point_hashes,
)
from solidcloud.builder.voxel.exact_enclosure import loose_nodes
from solidcloud.builder.voxel.record_points import PointBlock, hash_limit, iter_points, leaves_of, spheres_of
from solidcloud.builder.voxel.voxel_octree import VoxelPoints
from solidcloud.schemas.archive.codec import DecompressedRecord

pytestmark = pytest.mark.interpreted

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
BASE = np.array([-(1 << 40) + 3, 7, (1 << 35) + 5])


def joined(parts: list[PointBlock]) -> PointBlock:
    """Blocks as one."""
    return PointBlock(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def hash_by_hand(point: list[int]) -> int:
    """The hash of one lattice point in Python's integers."""
    mask, h = (1 << 64) - 1, 0
    for w in point:
        h ^= w & mask
        for factor in (0xFF51AFD7ED558CCD, 0xC4CEB9FE1A85EC53):
            h ^= h >> 33
            h = h * factor & mask
        h ^= h >> 33
    return h


@pytest.mark.parametrize("kind", ["duplicates", "one point"])
@pytest.mark.parametrize("steps", [1000, 1 << 21])
@pytest.mark.parametrize("block", [32, 70])
def test_all_points_come_in_blocks_leaf_node_by_leaf_node(kind: str, steps: int, block: int) -> None:
    record = open_scan(kind, 3, 150, steps)
    points, nodes = points_of(record)
    parts = list(iter_points(record, BASE, block=block))
    assert max(len(p.rows) for p in parts) <= block and min(len(p.rows) for p in parts) > 0
    found, order = joined(parts), np.argsort(nodes, kind="stable")
    assert found.rows.tolist() == order.tolist()
    assert found.xyz.tolist() == points[order].tolist()
    assert found.nodes.tolist() == nodes[order].tolist()


def test_a_box_has_its_corners() -> None:
    record = open_scan("noise", 4, 200, 60)
    points, _ = points_of(record)
    box = np.array([[4, 5, 12], [43, 51, 50]])
    inside = ((points >= box[0]) & (points <= box[1])).all(axis=1)
    assert 20 < inside.sum() < 150
    box = np.stack([points[inside].min(axis=0), points[inside].max(axis=0)])  # with points on every face
    found = joined(list(iter_points(record, BASE, box=box + BASE)))
    assert sorted(found.rows.tolist()) == np.flatnonzero(inside).tolist()
    assert list(iter_points(record, BASE, box=box + BASE + 1000)) == []


@pytest.mark.parametrize("share", [0.03, 0.97])
def test_a_share_is_chosen_by_the_hash_of_lattice_coordinates(share: float) -> None:
    record = open_scan("corner", 5, 300, 4000)
    points, _ = points_of(record)
    lattice = (points + BASE).tolist()
    hashes = [hash_by_hand(p) for p in lattice]
    assert [int(point_hash(*map(np.int64, p))) for p in lattice[:20]] == hashes[:20]
    chosen = [h < int(share * 2.0**64) for h in hashes]
    assert abs(sum(chosen) / 300 - share) < 0.1
    found = joined(list(iter_points(record, BASE, limit=hash_limit(share), block=40)))
    assert sorted(found.rows.tolist()) == np.flatnonzero(chosen).tolist()
    assert point_hashes(points + BASE).tolist() == hashes
    assert hash_limit(1.0) == hash_limit(7.0) == 0 < hash_limit(1e-30)


@pytest.mark.parametrize("kind", ["duplicates", "one point"])
@pytest.mark.parametrize("steps", [1000, 1 << 21])
def test_points_are_measured(kind: str, steps: int) -> None:
    record = open_scan(kind, 7, 150, steps)
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    assert measure_points(leaves_of(record), np.int64(steps), low, high)
    points, _ = points_of(record)
    assert (low.tolist(), high.tolist()) == (points.min(axis=0).tolist(), points.max(axis=0).tolist())


def spoilt(record: DecompressedRecord, plane: int, row: int, value: int) -> DecompressedRecord:
    """The record with one byte of its points another."""
    planes = record.planes.copy()
    planes[plane, row] = value
    planes.flags.writeable = False
    return record._replace(planes=planes)


@pytest.mark.parametrize("plane", [1, 3, 5])
def test_a_point_outside_its_cell_is_found(plane: int) -> None:
    record = open_scan("noise", 8, 150, 1 << 12)
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for row in (0, 77, 149):
        assert not measure_points(
            leaves_of(spoilt(record, plane, row, 255)), np.int64(record.voxel_steps), low, high
        )
    # Inside its cell, which ends beyond the voxel.
    record = open_points(VoxelPoints(np.array([[0, 0, 0], [599, 0, 0]], np.int32)), 600)
    assert measure_points(leaves_of(record), np.int64(600), low, high) and high.tolist() == [599, 0, 0]
    assert not measure_points(leaves_of(record), np.int64(599), low, high)


class Bounds:
    """The bounds of a record's nodes, to be changed, and what kernel and integers say of them."""

    def __init__(self, record: DecompressedRecord) -> None:
        self.voxel, self.links = record.decode()
        self.leaves, self.spheres = leaves_of(record), spheres_of(record)
        self.radius, self.normal = self.spheres.radius.copy(), record.nodes.normal
        self.slab = record.nodes.slab.copy()

    def named(self) -> int:
        """What the kernel says."""
        spheres = self.spheres._replace(radius=self.radius)
        return int(last_unenclosing_node(self.leaves, spheres, self.normal, self.slab))

    def proved(self) -> list[int]:
        """What Python's integers say."""
        nodes = self.voxel.nodes._replace(radius=self.radius, slab=np.ascontiguousarray(self.slab.T))
        return loose_nodes(self.voxel._replace(nodes=nodes), self.links, range(len(self.radius)))


@pytest.mark.parametrize("kind", ["corner", "noise"])
@pytest.mark.parametrize("steps", [1000, 1 << 21])
def test_a_bound_one_step_too_tight_is_named(kind: str, steps: int) -> None:
    """Of every node in turn, in the top hierarchy and in cells: a radius, and either side of its slab."""
    bounds = Bounds(open_scan(kind, 5, 40 if INTERPRETED else 60, steps, cell_points=20))
    assert bounds.named() == -1 and bounds.proved() == []
    tight = {"radius": 0, "low": 0, "high": 0}
    for node in range(len(bounds.radius)):
        for name, column, by in (
            ("radius", bounds.radius, -1),
            ("low", bounds.slab[0], 1),
            ("high", bounds.slab[1], -1),
        ):
            if name == "radius" and not column[node]:
                continue
            column[node] = int(column[node]) + by
            expected = bounds.proved()
            assert expected in ([], [node]) and bounds.named() == (node if expected else -1)
            tight[name] += bool(expected)
            column[node] = int(column[node]) - by
    # Bounds are mostly as tight as that; the top hierarchy's radii are of a larger unit.
    assert min(tight.values()) > (5 if INTERPRETED else 10)
