"""Test that no damaged or foreign record is accepted."""

import struct

import numpy as np
import pytest
import zstandard
from opened_records import ARCHIVE_ID, KEY, assert_same_bits, decode, shape_of
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.voxel.voxel_octree import VoxelPoints, build_voxel
from solidcloud.schemas.archive.codec import Record, encode_voxel
from solidcloud.schemas.archive.voxel import VoxelData, link_nodes
from solidcloud.schemas.errors import CorruptError
from synthetic_scans import make_steps


@pytest.fixture(scope="module")
def small() -> tuple[VoxelData, Record]:
    """A small voxel of several cells, and its record."""
    config = BuildConfig(leaf=8, cell_points=8, degree=2)
    voxel = build_voxel(KEY, VoxelPoints(make_steps("corner", 1, 24, 1000)), 1000, config)
    return voxel, encode_voxel(voxel, ARCHIVE_ID)


@pytest.mark.parametrize("name", ["cells", "nodes", "points"])
def test_every_flipped_bit_is_refused_or_means_nothing(name: str, small: tuple[VoxelData, Record]) -> None:
    voxel, record = small
    frame = getattr(record, name)
    passed = 0
    for at in range(len(frame)):
        for flip in [*(1 << bit for bit in range(8)), 0xFF]:
            broken = bytearray(frame)
            broken[at] ^= flip
            try:
                found, _ = decode(record, voxel, 1000, **{name: bytes(broken)})
            except CorruptError as error:
                assert f"voxel {KEY:#x}, {name}: " in str(error)
            else:
                # zstd has bits that its decoders must ignore, such as bit 4 of the frame header's descriptor
                # (RFC 8878, 3.1.1.1.1), and a match may be copied from another place that holds the same bytes:
                # then the content is the same.
                assert_same_bits(found, voxel)
                passed += 1
    assert passed <= 9 * len(frame) // 50


def test_a_frame_without_checksum_is_refused(small: tuple[VoxelData, Record]) -> None:
    voxel, record = small
    broken = bytearray(record.points)
    broken[4] ^= 1 << 2  # the frame header's checksum flag
    with pytest.raises(CorruptError, match="points: frame without checksum"):
        decode(record, voxel, 1000, points=bytes(broken))


def test_bytes_behind_a_frame_are_refused(small: tuple[VoxelData, Record]) -> None:
    voxel, record = small
    with pytest.raises(CorruptError, match="points: damaged frame"):
        decode(record, voxel, 1000, points=record.points + record.points[-4:])


@pytest.mark.parametrize("name", ["cells", "nodes", "points"])
def test_every_truncation_is_refused(name: str, small: tuple[VoxelData, Record]) -> None:
    voxel, record = small
    frame = getattr(record, name)
    for size in range(len(frame)):
        with pytest.raises(CorruptError, match=name):
            decode(record, voxel, 1000, **{name: frame[:size]})


@pytest.mark.parametrize("other", [{"key": KEY + 1}, {"archive_id": bytes(16)}])
def test_another_voxels_or_archives_record_is_refused(
    other: dict[str, object], small: tuple[VoxelData, Record]
) -> None:
    voxel, record = small
    with pytest.raises(CorruptError, match="belongs to another voxel or archive"):
        decode(record, voxel, 1000, **other)


@pytest.mark.parametrize("field", ["cell_rows", "node_rows", "point_rows"])
@pytest.mark.parametrize("delta", [-1, 1])
def test_other_rows_than_the_index_says_are_refused(
    field: str, delta: int, small: tuple[VoxelData, Record]
) -> None:
    voxel, record = small
    shape = shape_of(voxel)
    shape = shape._replace(**{field: getattr(shape, field) + delta})
    with pytest.raises(CorruptError, match=r"frame of \d+ bytes, expected \d+|cells claim"):
        decode(record, voxel, 1000, shape=shape)


def test_a_frame_that_declares_more_is_refused_before_memory_is_taken(
    small: tuple[VoxelData, Record],
) -> None:
    voxel, record = small
    # A single segment with an eight-byte content size of 2^62: to allocate it would be a MemoryError.
    bomb = struct.pack("<IBQ", 0xFD2FB528, 0b11100100, 1 << 62) + record.points[6:]
    with pytest.raises(CorruptError, match=f"frame of {1 << 62} bytes, expected"):
        decode(record, voxel, 1000, points=bomb)
    undeclared = zstandard.ZstdCompressor(write_content_size=False, write_checksum=True).compress(bytes(999))
    with pytest.raises(CorruptError, match="points: frame of"):
        decode(record, voxel, 1000, points=undeclared)


@pytest.mark.interpreted
@pytest.mark.parametrize("along", ["the sort axis", "another axis"])
def test_a_point_outside_its_cell_is_refused(along: str, small: tuple[VoxelData, Record]) -> None:
    voxel, _ = small
    links = link_nodes(voxel)
    # In a cell that ends inside the voxel, so that it is the cell's edge that counts.
    ends = voxel.cells.low + (1 << voxel.cells.log2_size.astype(np.int64))[:, None]
    node = int(np.flatnonzero(links.is_leaf & (ends < 1024).all(axis=1)[links.cell])[0])
    axis = int(voxel.nodes.axis[node]) if along == "the sort axis" else (int(voxel.nodes.axis[node]) + 1) % 3
    last = int(links.first[node]) + int(voxel.nodes.count[node]) - 1
    size = 1 << int(voxel.cells.log2_size[links.cell[node]])
    points = voxel.points.copy()
    for value, inside in ((size - 1, True), (size, False), (65535, False)):
        points[last, axis] = value - int(voxel.nodes.block_low[node, axis])
        record = encode_voxel(voxel._replace(points=points), ARCHIVE_ID)
        if inside:
            assert_same_bits(decode(record, voxel, 1024)[0], voxel._replace(points=points))
        else:
            with pytest.raises(CorruptError, match=f"voxel {KEY:#x}: a point outside its cell"):
                decode(record, voxel, 1024)


@pytest.mark.interpreted
def test_deltas_that_run_beyond_16_bits_are_refused(small: tuple[VoxelData, Record]) -> None:
    voxel, _ = small
    links = link_nodes(voxel)
    node = int(np.flatnonzero(links.is_leaf & (voxel.nodes.count > 1))[0])
    first, axis = int(links.first[node]), int(voxel.nodes.axis[node])
    points = voxel.points.copy()
    # Descending: the second delta is 65,535, and the sum comes back inside the cell if it wraps.
    points[first : first + 2, axis] = [1, 0]
    record = encode_voxel(voxel._replace(points=points), ARCHIVE_ID)
    with pytest.raises(CorruptError, match="a point outside its cell"):
        decode(record, voxel, 1000)


def test_a_sort_axis_out_of_range_is_refused_before_it_is_used(small: tuple[VoxelData, Record]) -> None:
    voxel, record = small
    axis = voxel.nodes.axis.copy()
    axis[-1] = 3
    rows = np.frombuffer(zstandard.ZstdDecompressor().decompress(record.nodes), np.uint8).copy()
    # The byte plane of `axis` is the 21st of a node's 27.
    rows.reshape(27, -1)[20] = axis
    frame = zstandard.ZstdCompressor(write_checksum=True).compress(rows.tobytes())
    with pytest.raises(CorruptError, match="sort axis 3"):
        decode(record, voxel, 1000, nodes=frame)
