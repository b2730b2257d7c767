"""Test the check of bounds: a bound just wide enough passes, one a step tighter is named."""

import numpy as np
import pytest
from opened_records import open_scan
from solidcloud.builder.kernels.points.voxel_records import last_unenclosing_node
from solidcloud.builder.voxel.exact_enclosure import loose_nodes
from solidcloud.builder.voxel.record_points import leaves_of, spheres_of
from solidcloud.schemas.archive.codec import DecompressedRecord

pytestmark = pytest.mark.interpreted


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
@pytest.mark.parametrize("steps", [1000, 1 << 18, 1 << 21])
def test_a_bound_one_step_too_tight_is_named(kind: str, steps: int) -> None:
    """Of every node in turn, in the top hierarchy and in cells: a radius, and either side of its slab."""
    bounds = Bounds(open_scan(kind, 5, 60, steps, cell_points=20))
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
    assert min(tight.values()) > 10


def test_of_several_the_last_is_named() -> None:
    bounds = Bounds(open_scan("noise", 6, 60, 5000))
    rng, told = np.random.default_rng(7), set()
    for _ in range(20):
        before = bounds.radius.copy()
        bounds.radius[rng.integers(0, len(before), 3)] //= 3
        expected = bounds.proved()
        assert bounds.named() == max(expected, default=-1)
        told.add((len(expected), bounds.named()))
        bounds.radius = before
    assert len(told) > 5 and max(told)[0] > 1


def test_a_node_without_a_slab_has_none_that_could_be_loose() -> None:
    bounds = Bounds(open_scan("noise", 8, 60, 5000))
    bounds.slab[:] = np.array([[1], [-1]])
    assert bounds.named() >= 0
    bounds.normal = np.zeros_like(bounds.normal)
    assert bounds.named() == -1
