"""Test that every number of an index out of its range is refused, under a right checksum."""

import shutil
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from forged_archives import Columns, bomb, forge, put_frame, read_index, write_index
from small_builds import build
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import CorruptError, FormatError
from synthetic_scans import make_scan, write_xyz

Change = Callable[[Columns], None]
GOLDEN = Path(__file__).resolve().parents[3] / "golden"


def put(name: str, at: int | tuple[int, ...], value: object) -> Change:
    """One number of a dataset."""
    return lambda columns: columns[name].__setitem__(at, value)


def field(name: str, value: object, at: tuple[int, ...] = (), row: int = 0) -> Change:
    """One number of a voxel's row."""
    return lambda columns: columns["voxels"][name].__setitem__((row, *at), value)


def of_rows(i: int, value: int) -> Change:
    """So many rows of one dataset of the first voxel, and as many points more or fewer in the sums."""

    def change(columns: Columns) -> None:
        rows = columns["voxels"]["rows"]
        if i == 2:
            more = value - int(rows[0, 2])
            columns["points"][0] = int(columns["points"][0]) + more
            columns["source_count"][0] = int(columns["source_count"][0]) + more
        rows[0, i] = value

    return change


def without(name: str) -> Change:
    """A dataset less."""
    return lambda columns: columns.__delitem__(name)


def other(name: str, value: np.ndarray) -> Change:
    """Another dataset of that name."""
    return lambda columns: columns.__setitem__(name, value)


def texts(before: bytes, after: bytes) -> Change:
    """Other texts."""

    def change(columns: Columns) -> None:
        data = columns["texts"].tobytes()
        assert before in data
        columns["texts"] = np.frombuffer(data.replace(before, after, 1), np.uint8)

    return change


def same_frame(columns: Columns) -> None:
    """The second voxel's nodes where the first one's are."""
    for name in ("frame_offset", "frame_bytes", "frame_checksum"):
        columns["voxels"][name][1, 1] = columns["voxels"][name][0, 1]


def twice(columns: Columns) -> None:
    """The same shard by two numbers."""
    columns["shards"] = np.repeat(columns["shards"], 2)


NAN, INF = float("nan"), float("inf")
CHANGES: dict[str, tuple[Change, str]] = {
    "origin NaN": (put("origin", 0, NAN), r"origin .*expected numbers from -1e\+09 to 1e\+09"),
    "origin infinite": (put("origin", 2, -INF), "origin .*expected numbers"),
    "origin far": (put("origin", 1, 1.1e9), "origin .*expected numbers"),
    "step 0": (put("step", 0, 0.0), "step .*expected numbers from 1e-06"),
    "step NaN": (put("step", 0, NAN), "step .*expected numbers"),
    "step negative": (put("step", 0, -1e-4), "step .*expected numbers"),
    "step infinite": (put("step", 0, INF), "step .*expected numbers"),
    "step too small": (put("step", 0, 9e-7), "step .*expected numbers"),
    "voxel of 10^10 m": (put("step", 0, 1e8), "step and voxel_steps .*expected voxels of at most"),
    "scene of 10^9 m": (put("step", 0, 1.9e5), "bounds .*within 1e"),
    "no voxel steps": (put("voxel_steps", 0, 0), "voxel_steps .*from 1 to"),
    "too many voxel steps": (put("voxel_steps", 0, (1 << 21) + 1), "voxel_steps .*from 1 to"),
    "bounds inverted": (put("bounds", (0, 0), 1 << 30), "bounds .*low up to high"),
    "bounds far away": (put("bounds", (1, 0), 1 << 62), "bounds .*low up to high"),
    "bounds larger": (put("bounds", (1, 0), 20_000), "the voxels' bounds are not the scene's"),
    "moved NaN": (put("moved_max", 0, NAN), "moved_max .*expected numbers from 0"),
    "moved by more than a step": (put("moved_max", 0, 1.0), "moved_max .*expected numbers"),
    "radius NaN": (put("radius", 0, NAN), r"radius .*expected numbers from 0 to 1e\+09"),
    "radius negative": (put("radius", 0, -0.01), "radius .*expected numbers from 0"),
    "radius infinite": (put("radius", 0, INF), "radius .*expected numbers from 0"),
    "radius error NaN": (put("radius", 1, NAN), "radius .*expected numbers from 0"),
    "more asked than there are": (put("radius_sample", 0, 1 << 60), "radius_sample .*expected numbers"),
    "no points": (put("points", 0, 0), "points .*expected numbers from 1"),
    "more points": (put("points", 0, 5000), "source_count of .*expected"),
    "degree 1": (put("tree", 0, 1), "tree .*expected 2 to 16"),
    "degree 17": (put("tree", 0, 17), "tree .*expected 2 to 16"),
    "leaf 0": (put("tree", 1, 0), "tree .*1 to 32"),
    "leaf 33": (put("tree", 1, 33), "tree .*1 to 32"),
    "leaf 1": (put("tree", 1, 1), "rows and leaves .*that form trees"),
    "flag 2": (put("columns", 0, 2), "columns .*from 0 to 1"),
    "three flags": (other("columns", np.array([1, 1, 0], "u1")), "columns .*expected 2 flags"),
    "four flags without classes": (other("columns", np.array([1, 1, 0, 0], "u1")), "columns .*expected 2 flags"),
    "five flags": (other("columns", np.array([1, 1, 0, 0, 0], "u1")), "columns .*expected 2 flags"),
    "seven flags without colours": (other("columns", np.array([1, 1, 0, 0, 0, 0, 0], "u1")), "columns .*expected 2"),
    "a fifth flag": (other("columns", np.array([1, 1, 0, 0, 1, 1, 0], "u1")), "columns .*the fifth 0"),
    "colours of another version": (other("columns", np.array([1, 1, 0, 0, 0, 1, 0], "u1")), "format_version 1.*5"),
    "classes that are not there": (other("columns", np.array([1, 1, 1, 0], "u1")), "datasets .*those of columns"),
    "a later generation in part": (other("generation", np.array([1], "<u4")), "datasets .*those of columns"),
    "a later version": (
        lambda c: c.update(generation=np.array([1], "<u4"), radius_now=np.zeros(3)), "format_version 1: expected 3"
    ),
    "unknown box inverted": (
        other("unknown", np.array([[[1, 0, 0], [0, 9, 9]]])), "unknown .*low up to high"
    ),
    "unknown box far away": (
        other("unknown", np.array([[[0, 0, 0], [0, 0, 1 << 62]]])), "unknown .*low up to high"
    ),
    "half unknown": (put("unknown_everywhere", 0, 2), "unknown_everywhere .*from 0 to 1"),
    "pose NaN": (put("source_pose", (0, 1, 1), NAN), "source_pose .*expected finite"),
    "pose of another last row": (put("source_pose", (0, 3, 3), 2.0), "source_pose .*last row 0 0 0 1"),
    "fewer counts": (lambda c: c.update(source_count=c["source_count"][:-1]), "source_count of 5 sources"),
    "counts that are not the points": (put("source_count", 0, 7), "source_count of .*expected"),
    "texts of a megabyte": (other("texts", np.full(4 << 20, 32, "u1")), "texts of 4194304 bytes"),
    "texts that nest": (other("texts", np.full(300_000, ord("["), "u1")), "texts|recursion"),
    "texts that are no JSON": (other("texts", np.full(3, ord("x"), "u1")), "Expecting value"),
    "a number for a path": (texts(b'"path":"', b'"path":3,"q":"'), "texts: Expected `str`, got `int`"),
    "a negative count in texts": (texts(b'"skipped":{', b'"skipped":{"a":-1'), "texts: Expected `int` >= 0"),
    "NaN in texts": (texts(b'"options":{', b'"options":{"a":NaN,'), "texts with NaN"),
    "no sources in texts": (texts(b'"sources":', b'"resources":'), "texts: Object missing required field `sources`"),
    "another lattice source": (texts(b'"lattice_source":"', b'"lattice_source":"x'), "texts: Invalid enum value"),
    "a dataset less": (without("moved_max"), "datasets without moved_max"),
    "a dataset more": (other("extra", np.zeros(1)), "dataset 'extra': expected one of"),
    "another type": (other("radius", np.zeros(2, "<f4")), "radius <f4 .*expected <f8"),
    "another shape": (other("origin", np.zeros((3, 1))), r"origin <f8 \(3, 1\): expected <f8 \(3,\)"),
    "a shard twice": (twice, "names a shard twice"),
    "no shard": (field("shard", 1), "is inconsistent"),
    "no voxels": (lambda c: c.update(voxels=c["voxels"][:0]), "is inconsistent"),
    "a key twice": (lambda c: field("key", c["voxels"]["key"][0], row=1)(c), "is inconsistent"),
    "a key of 64 bits": (field("key", (1 << 64) - 1, row=-1), "is inconsistent"),
    "another voxel": (field("key", 1), "the voxels' bounds are not the scene's"),
    "a frame beyond the end": (field("frame_offset", 1 << 40, (1,)), "beyond a shard's end"),
    "a frame whose end wraps": (field("frame_offset", (1 << 64) - 1, (1,)), "beyond a shard's end"),
    "a frame of 4 GB": (field("frame_bytes", (1 << 32) - 1, (1,)), "beyond a shard's end"),
    "a frame of nothing": (field("frame_bytes", 0, (1,)), "frame under 13 bytes"),
    "a frame for two": (same_frame, "shares bytes with another frame"),
    "no cells": (of_rows(0, 0), "rows and leaves .*that form trees"),
    "more cells than leaf nodes": (of_rows(0, 5000), "rows and leaves .*that form trees"),
    "fewer nodes than leaf nodes": (of_rows(1, 1), "rows and leaves .*that form trees"),
    "more nodes than levels hold": (of_rows(1, 1 << 31), "rows and leaves .*that form trees"),
    "fewer points than leaf nodes": (of_rows(2, 1), "rows and leaves .*that form trees"),
    "more points than leaf nodes hold": (of_rows(2, 500_000_000), "rows and leaves .*that form trees"),
    "no leaf nodes": (field("leaves", 0), "rows and leaves .*that form trees"),
    "points of voxels that do not add up": (
        lambda c: c["voxels"]["rows"].__setitem__((0, 2), c["voxels"]["rows"][0, 2] - 1), "points 1001: expected 1000"
    ),
    "low below the voxel": (field("low", -1, (0,)), "bounds .*expected low up to high"),
    "high above the voxel": (field("high", 9000, (0,)), "bounds .*expected low up to high"),
    "low above high": (field("low", 9000, (0,)), "bounds .*expected low up to high"),
}  # fmt: skip


@pytest.mark.parametrize("name", CHANGES)
def test_a_forged_number_is_refused_by_its_own_guard(name: str, copy: Path) -> None:
    change, message = CHANGES[name]
    forge(copy, change)
    with pytest.raises(FormatError, match=rf"archive(/index\.h5)?: .*({message})"):
        Archive(copy)


LATER: dict[str, tuple[Change, str]] = {
    "generation 0": (put("generation", 0, 0), "generation .*from 1"),
    "radius NaN": (put("radius_now", 0, NAN), "radius_now .*expected a radius"),
    "error infinite": (put("radius_now", 1, INF), "radius_now .*expected a radius"),
    "more asked than there are": (put("radius_now", 2, 1e15), "radius_now .*expected a radius"),
    "half a point asked": (put("radius_now", 2, 0.5), "radius_now .*expected a radius"),
}


@pytest.mark.parametrize("name", LATER)
def test_a_forged_number_of_a_later_generation_is_refused(name: str, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(GOLDEN / "archive-3", tmp_path / "archive"))
    change, message = LATER[name]
    forge(copy, change)
    with pytest.raises(FormatError, match=message):
        Archive(copy)


CLASSED: dict[str, tuple[Change, str]] = {
    "counts that are not the points": (put("radius_counts", 0, 1), "radius_counts .*expected those of"),
    "a count that wraps": (put("radius_counts", 31, (1 << 64) - 1), "radius_counts .*expected those of"),
    "more capped than there are": (put("radius_capped", 0, 1 << 40), "radius_capped .*expected those of"),
}


@pytest.mark.parametrize("name", CLASSED)
def test_forged_counts_of_radius_classes_are_refused(name: str, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(GOLDEN / "archive-2", tmp_path / "archive"))
    change, message = CLASSED[name]
    forge(copy, change)
    with pytest.raises(FormatError, match=message):
        Archive(copy)


def test_a_source_left_out_anywhere_makes_everything_unknown(copy: Path) -> None:
    forge(copy, texts(b'"skipped":', b'"unknown":-1,"skipped":'))
    with pytest.raises(FormatError, match="unknown_everywhere 0: expected 1"):
        Archive(copy)


BOMB_ROWS = 5_000_000


@pytest.fixture(scope="module")
def frame() -> bytes:
    """A small frame that declares 30 MB."""
    return bomb(6 * BOMB_ROWS)


def one_voxel(tmp_path: Path) -> Path:
    """An archive of one voxel, without optional columns."""
    scan = write_xyz(tmp_path / "a.xyz", make_scan("noise", 1, 400))
    build([scan], tmp_path / "archive", voxel=5.0)
    return tmp_path / "archive"


def forged_bomb(folder: Path, frame: bytes, forged: str) -> None:
    """A bomb in the place of the points; the index agrees with it as far as `forged` says."""
    index = read_index(folder)
    columns, row = index.columns, index.columns["voxels"][0]
    put_frame(folder, columns, 0, 2, frame)
    row["rows"][2] = BOMB_ROWS
    columns["points"][0] = columns["source_count"][0] = BOMB_ROWS
    if forged == "leaves":
        row["leaves"] = BOMB_ROWS // 16
    write_index(folder, index)


MOST_CELLS = 60_000_000


def forged_small_bomb(folder: Path) -> None:
    """Points that take 57 MB, and nodes of 16 MB, as many as the index may say; the cells are those of 400 points."""
    index = read_index(folder)
    columns, row = index.columns, index.columns["voxels"][0]
    row["leaves"] = 600_000
    columns["points"][0] = columns["source_count"][0] = row["rows"][2] = 16 * 600_000
    row["rows"][1] = 620_000
    for i, width in ((1, 27), (2, 6)):
        put_frame(folder, columns, 0, i, bomb(width * int(row["rows"][i])))
    write_index(folder, index)


def peak_of(work: Callable[[], object]) -> int:
    """The bytes that `work` takes at most."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("forged", ["points", "leaves"])
def test_a_bomb_is_refused_when_the_archive_is_opened(forged: str, tmp_path: Path, frame: bytes) -> None:
    folder = one_voxel(tmp_path)
    forged_bomb(folder, frame, forged)

    def refused() -> None:
        for read in (Archive, lambda path: verify_archive(path, deep=True)):
            with pytest.raises(FormatError, match="rows and leaves"):
                read(folder)

    assert peak_of(refused) < 1 << 20


def test_a_bomb_that_the_index_agrees_with_is_refused_by_the_cells_before_it_is_decompressed(
    tmp_path: Path,
) -> None:
    folder = one_voxel(tmp_path)
    forged_small_bomb(folder)

    def refused() -> None:
        with (
            Archive(folder) as archive,
            pytest.raises(CorruptError, match=r"do not form a tree|cells are inconsistent|cells claim"),
        ):
            archive.open_voxel(0)
        assert "cells claim 400 points" in verify_archive(folder, deep=True).faults[0]

    assert peak_of(refused) < 1 << 20
