"""Sorted runs: every row once, in canonical order, found by voxel and by block of a voxel."""

import pickle
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import solidcloud.builder.spool.spool as spool_module
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.spool.run_files import (
    KEYS_SUFFIX,
    is_run_damaged,
    new_run,
    spool_dtype,
    write_directory,
)
from solidcloud.builder.spool.spool import Spool
from solidcloud.schemas.archive.archive_writer import file_checksum
from solidcloud.schemas.archive.voxel_grid import make_lattice
from solidcloud.schemas.errors import CorruptError
from written_runs import write_run

LATTICE = make_lattice((0, 0, 0), 0.001, 0.1)
KEYS = np.array([3, 7, 1 << 61], np.uint64)


def interleaved(x: int, y: int, z: int) -> int:
    """The Morton code, bit by bit."""
    return sum(
        (value >> bit & 1) << (3 * bit + axis) for axis, value in enumerate((x, y, z)) for bit in range(21)
    )


def made(seed: int, count: int, keep: frozenset[str]) -> tuple[np.ndarray, np.ndarray]:
    """Keys and rows in no order, many of them equal."""
    rng = np.random.default_rng(seed)
    rows = np.zeros(count, spool_dtype(BuildConfig(keep=keep)))
    rows["local"] = rng.integers(0, 7, (count, 3))
    if keep:
        rows["scan_index"] = rng.integers(0, 3, count)
        rows["intensity"] = rng.choice(np.array([-2.5, 0, 1, np.nan], np.float32), count)
    return rng.choice(KEYS, count), rows


def judged(rows: np.ndarray) -> list[tuple]:
    """The canonical order of rows, as plain tuples; a NaN comes last."""
    plain = []
    for row in rows:
        more = ()
        if "intensity" in rows.dtype.names:
            value = float(row["intensity"])
            more = (int(row["scan_index"]), value != value, 0.0 if value != value else value)
        plain.append((interleaved(*row["local"].tolist()), *more))
    return plain


@pytest.mark.interpreted
@pytest.mark.parametrize("keep", [frozenset(), frozenset({"scan", "intensity"})])
def test_a_voxels_rows_are_found_once_and_in_order(keep: frozenset[str], tmp_path: Path) -> None:
    written = [made(seed, count, keep) for seed, count in enumerate((300, 1, 41))]
    for number, (keys, rows) in enumerate(written):
        write_run(tmp_path / f"{number}.run", keys, rows)
    all_keys = np.concatenate([k for k, _ in written])
    all_rows = np.concatenate([r for _, r in written])
    spool = pickle.loads(pickle.dumps(Spool(tmp_path, all_rows.dtype, LATTICE)))
    assert spool.keys.tolist() == sorted(set(all_keys.tolist()))
    for key, count in zip(spool.keys.tolist(), spool.counts.tolist(), strict=True):
        parts = spool.rows(key)
        assert len(parts) == sum(key in keys for keys, _ in written)
        for part in parts:
            assert judged(part) == sorted(judged(part))
        expected = all_rows[all_keys == key]
        assert sorted(judged(np.concatenate(parts))) == sorted(judged(expected))
        assert count == spool.count(key) == len(expected)
    assert (spool.rows(4), spool.count(4), spool.block_rows(4, 0, 1 << 63)) == ([], 0, [])


@pytest.mark.parametrize("stride", [1, 3, 64, 4096])
def test_a_block_is_what_brute_force_finds(
    stride: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spool_module, "CODE_STRIDE", stride)
    for number in range(3):
        write_run(tmp_path / f"{number}.run", *made(number, 150, frozenset()))
    spool = Spool(tmp_path, spool_dtype(BuildConfig()), LATTICE)
    rng = np.random.default_rng(9)
    blocks = [(0, 1 << 63), (0, 1), (5, 5), (0, 0), (511, 512), (512, 1 << 63)]
    blocks += [tuple(sorted(pair)) for pair in rng.integers(0, 520, (40, 2)).tolist()]
    for key in KEYS.tolist():
        for low, high in blocks:
            expected = [[code for code, *_ in judged(rows) if low <= code < high] for rows in spool.rows(key)]
            found = [[code for code, *_ in judged(rows)] for rows in spool.block_rows(key, low, high)]
            assert found == [codes for codes in expected if codes]
            assert spool.block_count(key, low, high) == sum(map(len, expected))


def test_a_run_that_lost_its_end_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.run"
    write_run(path, *made(1, 50, frozenset()))
    spool = Spool(tmp_path, spool_dtype(BuildConfig()), LATTICE)
    assert len(spool.keys) == 3
    path.write_bytes(path.read_bytes()[:-1])
    spool.rows(int(spool.keys[0]))
    with pytest.raises(CorruptError, match=r"a\.run: ends before row 50"):
        spool.rows(int(spool.keys[-1]))


NO_DIRECTORIES: dict[str, Callable[[list[int]], list[int]]] = {
    "nothing": lambda words: [],
    "an even number of words": lambda words: words[:-1],
    "two words more": lambda words: [*words, words[-1] + 1, words[-1] + 2],
    "a voxel twice": lambda words: [words[1], *words[1:]],
    "voxels that descend": lambda words: [words[1], words[0], *words[2:]],
    "a key of 64 bits": lambda words: [*words[:2], words[2] | 1 << 63, *words[3:]],
    "a first row left out": lambda words: [*words[:3], 1, *words[4:]],
    "a voxel without rows": lambda words: [*words[:4], words[5], *words[5:]],
    "rows that descend": lambda words: [*words[:4], words[5] + 1, *words[5:]],
    "a start of 64 bits": lambda words: [*words[:4], words[4] | 1 << 63, *words[5:]],
    "a row too many": lambda words: [*words[:-1], words[-1] + 1],
    "a row too few": lambda words: [*words[:-1], words[-1] - 1],
    "rows that overflow": lambda words: [*words[:-1], words[-1] + (1 << 62)],
}


@pytest.mark.parametrize("fault", [*NO_DIRECTORIES, "half a word"])
def test_what_can_be_no_directory_of_a_run_is_refused_and_the_run_named(fault: str, tmp_path: Path) -> None:
    run, dtype = tmp_path / "b.run", spool_dtype(BuildConfig())
    for path in (tmp_path / "a.run", run):
        write_run(path, *made(2, 60, frozenset()))
    file = run.with_suffix(KEYS_SUFFIX)
    words = np.fromfile(file, "<u8").tolist()
    assert Spool(tmp_path, dtype, LATTICE).counts.sum() == 120
    if fault in NO_DIRECTORIES:
        np.array(NO_DIRECTORIES[fault](words), "<u8").tofile(file)
    else:
        file.write_bytes(file.read_bytes() + b"half")
    with pytest.raises(CorruptError, match=r"b\.keys: not the directory of b\.run.*same command") as found:
        print(Spool(tmp_path, dtype, LATTICE).counts)
    assert found.value.paths == (run,)


def test_what_was_written_of_a_run_is_told_from_all_else(tmp_path: Path) -> None:
    run, (keys, rows) = tmp_path / "a.run", made(2, 20, frozenset({"scan", "intensity"}))
    order = np.argsort(keys, kind="stable")
    found, starts = np.unique(keys[order], return_index=True)
    with new_run(run) as file:
        for part in np.array_split(rows[order], 3):
            file.write(part.tobytes())
    sums = [*file.sums, *write_directory(run, found, np.append(starts, 20).astype(np.int64))]
    files = (run, run.with_suffix(KEYS_SUFFIX))
    assert sums == [of(path) for path in files for of in (lambda p: p.stat().st_size, file_checksum)]
    assert not is_run_damaged(run, sums)
    for path in files:
        data = path.read_bytes()
        for at in range(0, 8 * len(data), 7):  # each bit of a byte is among them
            path.write_bytes(flipped(data, at))
            assert is_run_damaged(run, sums)
        path.write_bytes(data + b"more")
        assert is_run_damaged(run, sums)
        path.unlink()
        assert not is_run_damaged(run, sums)  # nobody makes anything of it
        path.write_bytes(data)


def flipped(data: bytes, bit: int) -> bytes:
    """The same but for one bit."""
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)
