"""Test the optional columns of a record: read separately, left out, and out of range."""

import numpy as np
import pytest
from opened_records import ARCHIVE_ID, KEY, assert_same_bits, decode, kept, shape_of
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel
from solidcloud.schemas.archive.codec import OPTIONAL_COLUMNS, decompress_record, encode_voxel
from solidcloud.schemas.archive.radius_model import RADIUS_CLASSES
from solidcloud.schemas.archive.voxel import MAX_LEAF, VoxelData, link_nodes
from solidcloud.schemas.errors import CorruptError
from synthetic_scans import make_steps


@pytest.mark.interpreted
def test_classes_are_read_into_lanes_and_those_there_are_none_of_refused() -> None:
    points = make_steps("corner", 3, 200, 1000)
    config = BuildConfig(leaf=9, cell_points=40, degree=3)
    voxel = build_voxel(KEY, VoxelPoints(points, **kept(len(points), 4)), 1000, config)
    links = link_nodes(voxel)

    def lanes_of(voxel: VoxelData) -> np.ndarray:
        record = encode_voxel(voxel, ARCHIVE_ID)
        opened = decompress_record(*record[:3], shape_of(voxel), KEY, ARCHIVE_ID, 1000)
        lanes = np.empty((opened.leaves, MAX_LEAF), np.uint8)
        opened.read_classes(lanes)
        return lanes

    classes = voxel.radius_class
    assert classes is not None
    for lane, node in zip(lanes_of(voxel), np.flatnonzero(links.is_leaf), strict=True):
        first, count = int(links.first[node]), int(voxel.nodes.count[node])
        held = classes[first : first + count]
        assert np.array_equal(lane, np.append(held, np.full(MAX_LEAF - count, held[-1])))
    for at in (0, 77, 199):
        wrong = classes.copy()
        wrong[at] = RADIUS_CLASSES
        broken = voxel._replace(radius_class=wrong)
        with pytest.raises(CorruptError, match=f"radius class {RADIUS_CLASSES}, expected at most"):
            lanes_of(broken)
        with pytest.raises(CorruptError, match=f"radius class {RADIUS_CLASSES}, expected at most"):
            decode(encode_voxel(broken, ARCHIVE_ID), broken, 1000)


@pytest.mark.interpreted
@pytest.mark.parametrize(
    "stored", [(), ("intensity",), ("scan_index", "radius_class"), ("rgb",), OPTIONAL_COLUMNS]
)
@pytest.mark.parametrize(
    "wanted", [(), ("radius_class",), ("scan_index", "intensity"), ("rgb",), OPTIONAL_COLUMNS]
)
def test_columns_that_are_not_wanted_are_not_held(stored: tuple[str, ...], wanted: tuple[str, ...]) -> None:
    points = make_steps("noise", 3, 200, 1000)
    columns = {name: column for name, column in kept(200, 8).items() if name in stored}
    voxel = build_voxel(KEY, VoxelPoints(points, **columns), 1000, BuildConfig(leaf=8, cell_points=50))
    record = encode_voxel(voxel, ARCHIVE_ID)
    arguments = (record.cells, record.nodes, record.points, shape_of(voxel), KEY, ARCHIVE_ID, 1000)
    opened = decompress_record(*arguments, columns=wanted)
    assert opened.planes.shape == (opened.dtype.itemsize, 200) and not opened.planes.flags.writeable
    left_out = {name: None for name in stored if name not in wanted}
    assert_same_bits(opened.decode()[0], voxel._replace(**left_out))
    counts = np.zeros(RADIUS_CLASSES, np.int64)
    if "radius_class" in stored and "radius_class" in wanted:
        counts = np.bincount(voxel.radius_class, minlength=RADIUS_CLASSES)
    assert opened.class_counts().tolist() == counts.tolist()


@pytest.mark.parametrize("wanted", [(), ("radius_class",)])
def test_a_flipped_bit_of_a_column_that_is_not_wanted_is_found(wanted: tuple[str, ...]) -> None:
    config = BuildConfig(leaf=8, cell_points=8, degree=2)
    voxel = build_voxel(KEY, VoxelPoints(make_steps("corner", 1, 24, 1000), **kept(24, 9)), 1000, config)
    record, passed = encode_voxel(voxel, ARCHIVE_ID), 0
    for at in range(len(record.points)):
        for flip in (1, 0x10, 0x80):
            broken = bytearray(record.points)
            broken[at] ^= flip
            arguments = (record.cells, record.nodes, bytes(broken), shape_of(voxel), KEY, ARCHIVE_ID, 1000)
            try:
                found = decompress_record(*arguments, columns=wanted)
            except CorruptError as error:
                assert f"voxel {KEY:#x}, points: " in str(error)
            else:  # a bit that decoders must ignore
                unwanted = {name: None for name in OPTIONAL_COLUMNS if name not in wanted}
                assert_same_bits(found.decode()[0], voxel._replace(**unwanted))
                passed += 1
    assert passed <= 3 * len(record.points) // 50
