"""decode(encode(v)) == v bit for bit, and no damaged or foreign record gets through."""

import os
import struct
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st
from scans import WITH_POINTS, make_steps
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.octree import VoxelPoints, build_voxel
from solidcloud.schemas import codec
from solidcloud.schemas.codec import (
    OPTIONAL_COLUMNS,
    Record,
    RecordShape,
    RowStream,
    decode_voxel,
    encode_voxel,
    open_record,
    pwrite_all,
    voxel_point_dtype,
)
from solidcloud.schemas.errors import BadRequestError, CorruptError
from solidcloud.schemas.radius_model import RADIUS_CLASSES
from solidcloud.schemas.voxel import MAX_LEAF, Links, VoxelData, link_nodes

ARCHIVE_ID = bytes(range(16))
KEY = 0x1234567
INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"


def shape_of(voxel: VoxelData) -> RecordShape:
    """What an index would say of this voxel's record."""
    counts = len(voxel.cells.nodes), len(voxel.nodes.count), len(voxel.points)
    return RecordShape(*counts, voxel_point_dtype(voxel))


def decode(record: Record, voxel: VoxelData, steps: int, **other: object) -> tuple[VoxelData, Links]:
    """`decode_voxel` of a record as it should be, but for what `other` says."""
    arguments = {
        "cells": record.cells,
        "nodes": record.nodes,
        "points": record.points,
        "shape": shape_of(voxel),
        "key": voxel.key,
        "archive_id": ARCHIVE_ID,
        "voxel_steps": steps,
        **other,
    }
    return decode_voxel(**arguments)


def assert_same_bits(found: VoxelData, expected: VoxelData) -> None:
    """Every column of the same type, shape and bytes."""
    assert found.key == expected.key
    assert found.top_shift == expected.top_shift
    columns = [
        *zip(found.cells, expected.cells, strict=True),
        *zip(found.nodes, expected.nodes, strict=True),
        *((getattr(found, f), getattr(expected, f)) for f in ("points", *OPTIONAL_COLUMNS)),
    ]
    for a, b in columns:
        assert (a is None) == (b is None)
        if a is not None:
            assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())


def kept(n: int, seed: int) -> dict[str, np.ndarray]:
    """Optional columns of any bits, NaN among them."""
    rng = np.random.default_rng(seed)
    bits = rng.integers(0, 2**32, n, np.uint32)
    return {
        "scan_index": rng.integers(0, 2**16, n).astype(np.uint16),
        "intensity": bits.view(np.float32),
        "radius_class": rng.integers(0, RADIUS_CLASSES, n).astype(np.uint8),
    }


@st.composite
def voxels(draw: st.DrawFn) -> tuple[VoxelData, int]:
    """A voxel of random points, many of them equal or in line, of any size and tree, and its steps."""
    steps = draw(st.sampled_from([1, 2, 1000, 65535, 65536, 65537, 200_000, 1 << 21]))
    coordinate = st.integers(0, steps - 1) | st.sampled_from([0, steps - 1, min(65535, steps - 1)])
    rows = draw(st.lists(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=60))
    rows = rows * draw(st.integers(1, 3))
    if draw(st.booleans()):  # in line along an axis
        rows = [(x, rows[0][1], rows[0][2]) for x, _, _ in rows]
    config = BuildConfig(
        leaf=draw(st.integers(1, 32)),
        degree=draw(st.integers(2, 16)),
        cell_points=draw(st.sampled_from([1, 5, 4096])),
        with_slab=draw(st.booleans()),
    )
    columns = draw(st.sets(st.sampled_from(OPTIONAL_COLUMNS)))
    columns_of = {name: column for name, column in kept(len(rows), 7).items() if name in columns}
    return build_voxel(KEY, VoxelPoints(np.array(rows, np.int32), **columns_of), steps, config), steps


@pytest.mark.interpreted
@settings(max_examples=15 if INTERPRETED else 150, deadline=None)
@given(voxels())
def test_decoding_gives_back_what_was_encoded(case: tuple[VoxelData, int]) -> None:
    voxel, steps = case
    record = encode_voxel(voxel, ARCHIVE_ID)
    found, links = decode(record, voxel, steps)
    assert_same_bits(found, voxel)
    assert record.leaf_rows == int(links.is_leaf.sum())
    assert (record.cell_rows, record.node_rows, record.point_rows) == shape_of(voxel)[:3]


@pytest.mark.interpreted
@pytest.mark.parametrize("kind", WITH_POINTS)
@pytest.mark.parametrize("steps", [1000, 65536, 1 << 21])
def test_synthetic_scans_come_back(kind: str, steps: int) -> None:
    points = make_steps(kind, 3, 200, steps)
    config = BuildConfig(cell_points=50, leaf=16)
    voxel = build_voxel(KEY, VoxelPoints(points, **kept(len(points), 1)), steps, config)
    found, _ = decode(encode_voxel(voxel, ARCHIVE_ID), voxel, steps)
    assert_same_bits(found, voxel)


def test_the_same_voxel_has_the_same_bytes_in_any_order_of_points() -> None:
    points = make_steps("corner", 3, 300, 1000)
    columns = kept(300, 1)
    columns["intensity"] = np.nan_to_num(columns["intensity"])
    order = np.random.default_rng(9).permutation(300)
    config = BuildConfig(cell_points=50)
    a = build_voxel(KEY, VoxelPoints(points, **columns), 1000, config)
    b = build_voxel(
        KEY, VoxelPoints(points[order], **{k: c[order] for k, c in columns.items()}), 1000, config
    )
    assert encode_voxel(a, ARCHIVE_ID) == encode_voxel(b, ARCHIVE_ID)


@pytest.mark.interpreted
def test_classes_are_read_into_lanes_and_those_there_are_none_of_refused() -> None:
    points = make_steps("corner", 3, 200, 1000)
    config = BuildConfig(leaf=9, cell_points=40, degree=3)
    voxel = build_voxel(KEY, VoxelPoints(points, **kept(len(points), 4)), 1000, config)
    links = link_nodes(voxel)

    def lanes_of(voxel: VoxelData) -> np.ndarray:
        record = encode_voxel(voxel, ARCHIVE_ID)
        opened = open_record(*record[:3], shape_of(voxel), KEY, ARCHIVE_ID, 1000)
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
@pytest.mark.parametrize("stored", [(), ("intensity",), ("scan_index", "radius_class"), OPTIONAL_COLUMNS])
@pytest.mark.parametrize("wanted", [(), ("radius_class",), ("scan_index", "intensity"), OPTIONAL_COLUMNS])
def test_columns_that_are_not_wanted_are_not_held(stored: tuple[str, ...], wanted: tuple[str, ...]) -> None:
    points = make_steps("noise", 3, 200, 1000)
    columns = {name: column for name, column in kept(200, 8).items() if name in stored}
    voxel = build_voxel(KEY, VoxelPoints(points, **columns), 1000, BuildConfig(leaf=8, cell_points=50))
    record = encode_voxel(voxel, ARCHIVE_ID)
    arguments = (record.cells, record.nodes, record.points, shape_of(voxel), KEY, ARCHIVE_ID, 1000)
    opened = open_record(*arguments, columns=wanted)
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
                found = open_record(*arguments, columns=wanted)
            except CorruptError as error:
                assert f"voxel {KEY:#x}, points: " in str(error)
            else:  # a bit that decoders must ignore
                unwanted = {name: None for name in OPTIONAL_COLUMNS if name not in wanted}
                assert_same_bits(found.decode()[0], voxel._replace(**unwanted))
                passed += 1
    assert passed <= 3 * len(record.points) // 50


def test_more_or_less_than_is_declared_is_refused_where_columns_are_not_wanted() -> None:
    columns = {"intensity": np.zeros(24, np.float32)}
    points = VoxelPoints(make_steps("corner", 1, 24, 1000), **columns)
    voxel = build_voxel(KEY, points, 1000, BuildConfig())
    record = encode_voxel(voxel, ARCHIVE_ID)
    shape = shape_of(voxel)
    for frame in (record.points + record.points, record.points[:-5], record.points[:20]):
        with pytest.raises(CorruptError, match="points: damaged frame"):
            open_record(record.cells, record.nodes, frame, shape, KEY, ARCHIVE_ID, 1000, columns=())


@pytest.mark.interpreted
def test_counting_refuses_a_class_there_is_none_of() -> None:
    classes = np.array([0, 31, 32, 7], np.uint8)
    points = VoxelPoints(np.arange(12, dtype=np.int32).reshape(4, 3), radius_class=classes)
    voxel = build_voxel(KEY, points, 1000, BuildConfig())
    record = encode_voxel(voxel, ARCHIVE_ID)
    opened = open_record(
        record.cells,
        record.nodes,
        record.points,
        shape_of(voxel),
        KEY,
        ARCHIVE_ID,
        1000,
        columns=("radius_class",),
    )
    with pytest.raises(CorruptError, match="radius class 32, expected at most 31"):
        opened.class_counts()


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
    with pytest.raises(CorruptError, match="another voxel's or another archive's"):
        decode(record, voxel, 1000, **other)


@pytest.mark.parametrize("field", ["cell_rows", "node_rows", "point_rows"])
@pytest.mark.parametrize("delta", [-1, 1])
def test_other_rows_than_the_index_says_are_refused(
    field: str, delta: int, small: tuple[VoxelData, Record]
) -> None:
    voxel, record = small
    shape = shape_of(voxel)
    shape = shape._replace(**{field: getattr(shape, field) + delta})
    with pytest.raises(CorruptError, match=r"frame of \d+ bytes, expected \d+"):
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


def test_what_check_voxel_refuses_is_refused(small: tuple[VoxelData, Record]) -> None:
    voxel, _ = small
    low = voxel.cells.low.copy()
    low[0, 0] += 1
    record = encode_voxel(voxel._replace(cells=voxel.cells._replace(low=low)), ARCHIVE_ID)
    with pytest.raises(CorruptError, match="a cell off its grid"):
        decode(record, voxel, 1000)


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


@pytest.mark.parametrize("cuts", [[], [1], [300, 301, 999]])
def test_rows_that_come_in_parts_are_one_frame_of_their_byte_planes(
    cuts: list[int], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(codec, "STREAM_BYTES", 700)
    rows = np.zeros(1000, [("x", "<u2", (3,)), ("y", "<f4")])
    rows["x"] = np.arange(3000).reshape(1000, 3) % 517
    rows["y"] = np.sqrt(np.arange(1000))
    frames = set()
    for reverse in (False, True):
        stream = RowStream(tmp_path, rows.dtype, len(rows))
        edges = [0, *cuts, len(rows)]
        parts = list(pairwise(edges))
        for a, b in reversed(parts) if reverse else parts:
            stream.put(a, rows[a:b])
        frames.add(bytes(stream.frame()))
    frame = frames.pop()
    assert not frames
    declared = zstandard.get_frame_parameters(frame)
    assert declared.content_size == rows.nbytes and declared.has_checksum
    planes = np.frombuffer(zstandard.ZstdDecompressor().decompress(frame), np.uint8).reshape(10, 1000)
    assert planes.T.tobytes() == rows.tobytes()
    assert not list(tmp_path.iterdir())


def test_planes_that_end_too_soon_are_seen(tmp_path: Path) -> None:
    stream = RowStream(tmp_path, np.dtype([("x", "<u2")]), 5)
    stream.put(1, np.array([(7,), (9,)], [("x", "<u2")]))
    with pytest.raises(CorruptError, match="planes of 5 rows end at byte 8, expected 10"):
        stream.frame()


def test_a_frame_of_more_bytes_than_the_index_counts_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(codec, "MAX_FRAME_BYTES", 30)
    stream = RowStream(tmp_path, np.dtype([("x", "<u2")]), 50)
    stream.put(0, np.array([(i * i,) for i in range(50)], [("x", "<u2")]))
    with pytest.raises(BadRequestError, match=r"a voxel of 50 rows takes \d+ bytes, a record holds 30"):
        stream.frame()


def test_a_write_that_takes_less_is_gone_on_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real = os.pwrite
    monkeypatch.setattr(os, "pwrite", lambda file, data, at: real(file, data[:3], at))
    with open(tmp_path / "a", "wb", buffering=0) as file:
        assert pwrite_all(file.fileno(), b"0123456789", 2) == 10
        assert pwrite_all(file.fileno(), np.array([0x4241], "<u2"), 12) == 2
    assert (tmp_path / "a").read_bytes() == b"\0\x000123456789AB"
