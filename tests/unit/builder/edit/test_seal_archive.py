"""Seals: what only one with the key can write is found to be changed, and without the key nothing changes."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from forged_archives import forge
from sealed_archives import FORGERIES, KEY, key_file, reseal
from solidcloud.builder.edit.edit_archive import add_scans, remove_scans
from solidcloud.builder.edit.seal_archive import seal_archive
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.level import open_level
from solidcloud.schemas.archive.seal import SEAL_NAME
from solidcloud.schemas.errors import FormatError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.scene import Scene
from synthetic_scans import make_scan, write_xyz


@pytest.mark.parametrize("name", FORGERIES)
def test_a_forgery_that_no_reader_can_find_is_found_with_the_key(
    name: str, copy: Path, tmp_path: Path
) -> None:
    FORGERIES[name](copy)
    Archive(copy).close()  # nothing contradicts anything
    if name == "covers that do not reach":
        with Archive(copy, KEY) as archive, pytest.raises(FormatError, match="not the seal of this index"):
            open_level(archive)
        assert "not the seal" in verify_archive(copy, key=KEY).faults[0]
    else:
        with pytest.raises(FormatError, match="not the seal of this index with this key"):
            Archive(copy, KEY)
        with pytest.raises(FormatError, match="not the seal of this index with this key"):
            verify_archive(copy, key=KEY)
    with pytest.raises(FormatError, match="not the seal"):
        Scene.open(copy, archive_key=key_file(tmp_path))
    # One with the key may do all of this.
    if name != "covers that do not reach" and (copy / "level").exists():
        reseal(copy)
        Archive(copy, KEY).close()


def test_a_record_that_is_not_the_sealed_one_is_unknown_and_never_clear(copy: Path, tmp_path: Path) -> None:
    shutil.rmtree(copy / "level")
    with Archive(copy) as archive:
        row = int(np.argmax(archive.voxels["rows"][:, 2]))
        voxel = archive.read_voxel(row)[0]
        lattice = archive.header.lattice
        corner = archive.coordinates[row] * lattice.voxel_steps
        place = lattice.to_world((corner + voxel.cells.low[0])[None])[0]
    forge(copy, lambda columns: columns["record_digest"].__setitem__(row, 0))
    reseal(copy)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[0, :3, 3], poses[1, :3, 3] = place, place + 100
    verdicts = []
    for key in (None, key_file(tmp_path)):
        with Scene.open(copy, archive_key=key) as scene:
            scene.add_avatar("ball", np.zeros((1, 3)), 0.3)
            verdicts.append(scene.collide("ball", poses).verdict.tolist())
    assert verdicts[0] == [Verdict.CONTACT, Verdict.CLEAR]
    assert verdicts[1] == [Verdict.UNKNOWN, Verdict.CLEAR]


# --- changes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("keeps_seal", [False, True])
def test_adding_and_removing_scans_removes_the_seal(keeps_seal: bool, copy: Path, tmp_path: Path) -> None:
    """And a seal that is left behind, as by a kill, is not taken for a good one."""
    seals = {name: (copy / name / SEAL_NAME).read_bytes() for name in (".", "level")}
    more = write_xyz(tmp_path / "more.xyz", make_scan("plane", 5, 200))
    add_scans(copy, [more], jobs=1)
    assert not (copy / SEAL_NAME).exists() and not (copy / "level" / SEAL_NAME).exists()
    with Archive(copy) as archive:
        assert not archive.header.is_sealed and archive.header.format_version == 3
    if keeps_seal:
        for name, seal in seals.items():
            (copy / name / SEAL_NAME).write_bytes(seal)
    with pytest.raises(FormatError, match="not the seal" if keeps_seal else "not found"):
        Archive(copy, KEY)
    with Archive(copy) as archive, pytest.raises(FormatError):
        archive.key = KEY
        open_level(archive)
    seal_archive(copy, KEY)
    remove_scans(copy, [str(more)], jobs=1)
    assert not (copy / SEAL_NAME).exists()
    seal_archive(copy, KEY)
    assert verify_archive(copy, deep=True, key=KEY).faults == ()
