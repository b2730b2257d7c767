"""A resumed build discards runs that differ from what was written, and ends in the bytes of an undisturbed build."""

import shutil
from pathlib import Path
from typing import Any

import pytest
import solidcloud.builder.passes.build_shards as build_shards
import solidcloud.builder.passes.spool_pass as spool_pass
import solidcloud.builder.passes.survey_pass as survey
from interrupted_builds import build, content, done_folder, interrupted
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.resume.kept_work import building_folder
from solidcloud.builder.spool.run_files import KEYS_SUFFIX, filter_dtype, spool_dtype

COLUMNS: dict[str, Any] = {"keep": frozenset({"scan", "intensity"})}
FILTERS: dict[str, Any] = {"thin": 0.01, "outliers": (0.3, 1), **COLUMNS}

# The pass that each work unit belongs to.
PASS_OF = {
    "survey_range": survey,
    "hash_file": survey,
    "spool_range": spool_pass,
    "build_shard": build_shards,
}


def runs(target: Path, folder: str = "spool") -> list[Path]:
    """The runs that an interrupted build has in a folder."""
    return sorted((done_folder(target) / folder).glob("*.run"))


def flip(path: Path, bit: int) -> None:
    """Change one bit of a file."""
    data = bytearray(path.read_bytes())
    data[bit // 8] ^= 1 << bit % 8
    path.write_bytes(data)


def as_it_was(kept: Path, target: Path) -> None:
    """An interrupted build once more."""
    shutil.rmtree(building_folder(target))
    shutil.copytree(kept, building_folder(target))


def counted(monkeypatch: pytest.MonkeyPatch, name: str) -> list[Any]:
    """The units that a function of the passes is given from now on."""
    units: list[Any] = []
    function = getattr(PASS_OF[name], name)
    monkeypatch.setattr(PASS_OF[name], name, lambda unit: units.append(unit) or function(unit))
    return units


@pytest.mark.parametrize("options", [{}, FILTERS], ids=["places", "filters"])
def test_any_bit_of_a_run_that_changed_makes_it_anew_and_nothing_else(
    options: dict[str, Any], scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    build(tmp_path / "judge", scans, **options)
    expected, target = content(tmp_path / "judge"), tmp_path / "hall"
    interrupted(target, scans, monkeypatch, **options)
    shutil.copytree(building_folder(target), tmp_path / "kept")
    dtype = filter_dtype(BuildConfig(**options)) if "thin" in options else spool_dtype(BuildConfig(**options))
    units = counted(monkeypatch, "spool_range")
    # In the middle row of a run: low and high bits of a coordinate, out of its cell, out of its voxel, and its sign.
    bits = [0, 20] if options == {} else [32 + 14]
    for name in ("scan_index", "intensity"):
        if name in (dtype.names or ()):
            bits.append(8 * dtype.fields[name][1] + 14)
    for bit in bits:
        as_it_was(tmp_path / "kept", target)
        run = runs(target)[0]
        row = run.stat().st_size // dtype.itemsize // 2
        flip(run, 8 * dtype.itemsize * row + bit)
        units.clear()
        build(target, scans, **options)
        assert len(units) == 1, bit
        assert content(target) == expected, bit
        shutil.rmtree(target)
        shutil.copytree(tmp_path / "kept", building_folder(target))


def test_any_word_of_a_directory_that_changed_makes_its_run_anew(
    scans: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    build(tmp_path / "judge", scans)
    target = tmp_path / "hall"
    interrupted(target, scans, monkeypatch)
    shutil.copytree(building_folder(target), tmp_path / "kept")
    spooled = {
        path.name: path.read_bytes()
        for path in done_folder(target).glob("spool/*.*")
        if path.suffix != ".tmp"
    }
    words = (runs(target)[0].with_suffix(KEYS_SUFFIX).stat().st_size) // 8
    assert words > 20
    for word in range(0, words, 7):
        as_it_was(tmp_path / "kept", target)
        flip(runs(target)[0].with_suffix(KEYS_SUFFIX), 64 * word + (0, 1, 31, 40, 62, 63)[word % 6])
        interrupted(target, scans, monkeypatch)
        found = {path.name: path.read_bytes() for path in done_folder(target).glob("spool/*.*")}
        assert {name: found.get(name) for name in spooled} == spooled, word
    build(target, scans)
    assert content(target) == content(tmp_path / "judge")
