"""Test scripts/damage_scans with a sample of its files, and that it finds a wrong answer."""

from pathlib import Path

import numpy as np
import pytest
from broken_scans import SEEDS
from intact_points import DAMAGES, damage, describe
from project_scripts import load_script
from solidcloud.builder.sources.formats import ply

damage_scans = load_script("damage_scans")


def test_no_intact_point_of_a_damaged_scan_is_clear(tmp_path: Path) -> None:
    """Test a share of the 2,000 files of scripts/damage_scans, of every format."""
    names = len(SEEDS)
    numbers = [names * k + (5 * k + step) % names for k in range(len(DAMAGES)) for step in range(0, names, 4)]
    found = damage_scans.run(7, numbers, [], tmp_path, None)
    assert found["faults"] == []
    assert set(found["by_file"]) == set(SEEDS) and set(found["by_damage"]) == set(DAMAGES)
    total = found["total"]
    assert total["files"] == len(numbers) and total["read"] > 5 and total["left out"] > 20
    assert total["contact"] > 500 and total["unknown"] > 2000


def test_a_reader_that_leaves_points_out_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the check of what follows the last record, a count that is too small loses points."""
    monkeypatch.setattr(ply, "check_end", lambda *_: None)
    monkeypatch.setattr(ply, "_skip_element", lambda *_: None)
    names = sorted(SEEDS)
    numbers = [names.index("little.ply") + len(names) * len(DAMAGES) * k for k in range(4)]
    found = damage_scans.run(7, numbers, [], tmp_path, None)
    assert found["total"]["clear wrongly"] > 100 and len(found["faults"]) == 2


def test_files_are_made_again_by_their_number(tmp_path: Path) -> None:
    for name, write in SEEDS.items():
        write(tmp_path / name, np.arange(180.0).reshape(60, 3) / 37)
        whole = describe(name, tmp_path / name)
        for kind in DAMAGES:
            one, other = (damage(whole, kind, np.random.default_rng([3, 5])) for _ in range(2))
            assert one.finish() == other.finish() and (one.intact() == other.intact()).all()
            same = np.flatnonzero(one.origin >= 0)
            kept = np.frombuffer(bytes(one.data), np.uint8)[same]
            assert (kept == np.frombuffer(whole.data, np.uint8)[one.origin[same]]).all()
