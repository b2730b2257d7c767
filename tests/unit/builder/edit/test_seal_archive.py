"""Seals: what only one with the key can write is found to be changed, and without the key nothing changes."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import solidcloud.builder.edit.seal_archive as seal_module
from forged_archives import forge, read_index, write_index
from sealed_archives import FORGERIES, KEY, OTHER_KEY, key_file, reseal
from solidcloud.builder.edit.edit_archive import add_scans, remove_scans
from solidcloud.builder.edit.renew_level import renew_level
from solidcloud.builder.edit.seal_archive import seal_archive
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.level import open_level
from solidcloud.schemas.archive.seal import SEAL_NAME
from solidcloud.schemas.errors import CorruptError, FormatError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.archives.masked_archive import MaskedArchive
from solidcloud.server.scene import Scene
from synthetic_scans import make_scan, write_xyz


def test_a_sealed_archive_is_what_it_was_for_all_without_a_key(plain: Path, sealed: Path) -> None:
    with Archive(plain) as before, Archive(sealed) as after:
        assert after.header.is_sealed and after.header.format_version == 5
        assert before.header.format_version == 3
        assert np.array_equal(before.voxels, after.voxels)
        for row in range(len(before.voxels)):
            assert before.read_frames(row) == after.read_frames(row)
        for name in ("points", "radius", "archive_id", "generation", "lattice", "options"):
            assert getattr(before.header, name) == getattr(after.header, name)
    kept = read_index(plain).columns
    found = read_index(sealed).columns
    assert found.pop("record_digest").shape == (len(kept["voxels"]), 2, 16)
    assert all(np.array_equal(kept[name], found[name]) for name in kept | found)
    assert verify_archive(sealed, deep=True).faults == ()


def test_an_archive_sealed_with_the_key_passes(sealed: Path) -> None:
    assert verify_archive(sealed, deep=True, key=KEY).faults == ()
    with Archive(sealed, KEY) as archive:
        level = open_level(archive)
        assert level is not None and level.key == KEY
        for each in (archive, level):
            for row in range(len(each.voxels)):
                each.read_voxel(row)
                each.open_tree(row)
        level.close()


def test_sealing_again_gives_the_same_bytes_and_another_key_another_seal(sealed: Path, copy: Path) -> None:
    seal_archive(copy, KEY)
    for name in ("index.h5", SEAL_NAME, f"level/{SEAL_NAME}", "level/index.h5"):
        assert (copy / name).read_bytes() == (sealed / name).read_bytes()
    seal_archive(copy, OTHER_KEY)
    assert (copy / SEAL_NAME).read_bytes() != (sealed / SEAL_NAME).read_bytes()
    assert verify_archive(copy, key=OTHER_KEY).faults == ()
    with pytest.raises(FormatError, match="not the seal of this index with this key"):
        Archive(copy, KEY)


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


def test_forgeries_pass_a_reader_without_the_key(copy: Path) -> None:
    """Or the test above would show nothing: those that contradict the file are found by `--deep` alone."""
    found_by = {}
    for name, forgery in FORGERIES.items():
        folder = Path(shutil.copytree(copy, copy.parent / name.replace(" ", "-")))
        forgery(folder)
        found_by[name] = bool(verify_archive(folder).faults)
    contradict = {"classes that are not counted", "a voxel in another cell"}
    assert {name for name, found in found_by.items() if found} == contradict


@pytest.mark.parametrize(
    "what", ["key", "missing", "empty", "longer", "of another archive", "without digests"]
)
def test_a_seal_that_is_none_is_refused(what: str, copy: Path, plain: Path) -> None:
    seal = copy / SEAL_NAME
    match = "not the seal of this index with this key"
    if what in ("missing", "empty"):
        match = "not found, expected the seal"
        seal.unlink()
        if what == "empty":
            seal.touch()
    elif what == "longer":
        seal.write_bytes(seal.read_bytes() + b"\0")
    elif what == "of another archive":
        shutil.copyfile(copy / "level" / SEAL_NAME, seal)
    elif what == "without digests":
        write_index(copy, read_index(plain))
        reseal(copy)
    with pytest.raises(FormatError, match=match):
        Archive(copy, OTHER_KEY if what == "key" else KEY)
    Archive(copy).close()


@pytest.mark.parametrize("with_key", [False, True])
def test_a_level_in_place_of_its_archive_is_refused(with_key: bool, copy: Path, tmp_path: Path) -> None:
    """Its seal is good, but its points are few: it would call poses clear that are not."""
    key = key_file(tmp_path) if with_key else None
    with pytest.raises(FormatError, match="a level of detail, expected an archive"):
        Scene.open(copy / "level", archive_key=key)
    shutil.move(copy / "level", tmp_path / "level")
    shutil.rmtree(copy)
    shutil.move(tmp_path / "level", copy)
    with pytest.raises(FormatError, match="a level of detail, expected an archive"):
        Scene.open(copy, archive_key=key)


@pytest.mark.parametrize("level", [False, True])
@pytest.mark.parametrize("part", [0, 1])
def test_a_record_with_another_digest_is_corrupt(part: int, level: bool, copy: Path) -> None:
    folder = copy / "level" if level else copy
    row = 1 if len(read_index(folder).columns["voxels"]) > 1 else 0
    forge(
        folder,
        lambda columns: columns["record_digest"].__setitem__(
            (row, part, 15), columns["record_digest"][row, part, 15] ^ 1
        ),
    )
    reseal(folder)
    with Archive(folder, KEY) as archive:
        with pytest.raises(
            CorruptError, match=f"{('cells and nodes', 'points')[part]} that are not those sealed"
        ):
            archive.read_voxel(row)
        if part == 0:
            with pytest.raises(CorruptError, match="cells and nodes"):
                archive.open_tree(row)
        else:
            archive.open_tree(row)  # which reads no points
        for other in set(range(len(archive.voxels))) - {row}:
            archive.read_voxel(other)
    with Archive(folder) as archive:
        archive.read_voxel(row)  # without the key, readers ignore digests
    for key in (None, KEY):
        faults = verify_archive(copy, key=key).faults
        assert len(faults) == 1 and "not those sealed" in faults[0]


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


def test_an_archive_without_some_points_is_checked_too(copy: Path) -> None:
    with Archive(copy, KEY) as archive:
        row = int(np.argmax(archive.voxels["rows"][:, 2]))
        lattice = archive.header.lattice
        low = lattice.to_world((archive.coordinates[row] * lattice.voxel_steps)[None])[0]
    box = np.stack([low + 0.1, low + 0.5])
    with MaskedArchive(copy, [box], key=KEY) as masked, MaskedArchive(copy, [box]) as judge:
        assert len(masked.voxels) == len(judge.voxels)
        assert any(
            np.array_equal(v, j) is False
            for v, j in zip(masked.voxels["rows"], archive.voxels["rows"], strict=False)
        )
        for at in range(len(masked.voxels)):
            assert masked.read_frames(at) == judge.read_frames(at)
    with pytest.raises(FormatError, match="not the seal"):
        MaskedArchive(copy, [box], key=OTHER_KEY)
    forge(copy, lambda columns: columns["record_digest"].__setitem__(row, 0))
    reseal(copy)
    with MaskedArchive(copy, [box], key=KEY) as masked:
        (at,) = np.flatnonzero(masked.voxels["key"] == archive.voxels["key"][row])
        with pytest.raises(CorruptError, match="not those sealed"):
            masked.read_voxel(int(at))


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


def test_another_level_must_be_sealed_again(copy: Path) -> None:
    renew_level(copy, jobs=1)
    with Archive(copy, KEY) as archive, pytest.raises(FormatError, match="not found, expected the seal"):
        open_level(archive)
    seal_archive(copy, KEY)
    assert verify_archive(copy, deep=True, key=KEY).faults == ()


def test_a_server_keeps_what_it_serves_if_the_seal_is_gone(copy: Path, tmp_path: Path) -> None:
    more = write_xyz(tmp_path / "more.xyz", make_scan("plane", 5, 200))
    with Scene.open(copy, archive_key=key_file(tmp_path)) as scene:
        before = scene.info().points
        add_scans(copy, [more], jobs=1)
        with pytest.raises(FormatError, match="not found, expected the seal"):
            scene.reload()
        assert scene.info().points == before
    seal_archive(copy, KEY)
    with Scene.open(copy, archive_key=key_file(tmp_path)) as scene:
        assert scene.info().points == before + 200


def test_every_archive_of_a_scene_file_must_be_sealed(copy: Path, plain: Path, tmp_path: Path) -> None:
    text = '[[archives]]\npath = "{}"\n'
    scene = tmp_path / "scene.toml"
    box = '[[effects]]\neffect = "through"\nboxes = [{name = "door", low = [0, 0, 0], high = [0.3, 0.3, 0.3]}]\n'
    for effects in ("", box):
        scene.write_text(f"format = 1\n{text.format(copy)}{effects}")
        Scene.open(scene, archive_key=key_file(tmp_path)).close()
        with pytest.raises(FormatError, match="not the seal"):
            Scene.open(scene, archive_key=key_file(tmp_path, OTHER_KEY))
        scene.write_text(f"format = 1\n{text.format(copy)}{text.format(plain)}{effects}")
        with pytest.raises(FormatError, match=r"archives\[1\].*not found, expected the seal"):
            Scene.open(scene, archive_key=key_file(tmp_path))


@pytest.mark.parametrize("stops_at", range(4))
def test_a_sealing_that_is_interrupted_leaves_an_archive_without_a_seal(
    stops_at: int, plain: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It stops before each of the files that it writes: the level's index and seal, and the archive's."""
    copy = Path(shutil.copytree(plain, tmp_path / "archive"))
    seal_archive(copy, OTHER_KEY)  # an earlier seal
    written = 0

    def stopping(write: Callable[..., object]) -> Callable[..., object]:
        def instead(*arguments: object) -> object:
            nonlocal written
            written += 1
            if written > stops_at:
                raise KeyboardInterrupt
            return write(*arguments)

        return instead

    with monkeypatch.context() as patch:
        for name in ("write_columns", "new_file"):
            patch.setattr(seal_module, name, stopping(getattr(seal_module, name)))
        with pytest.raises(KeyboardInterrupt):
            seal_archive(copy, KEY)
    assert verify_archive(copy, deep=True).faults == ()
    with pytest.raises(FormatError, match="not the seal"):
        Archive(copy, KEY)
    seal_archive(copy, KEY)
    assert verify_archive(copy, key=KEY).faults == ()
    assert not list(copy.rglob("*.tmp"))


def test_a_damaged_archive_is_not_sealed(plain: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(plain, tmp_path / "archive"))
    with Archive(copy) as archive:
        entry = archive.voxels[0]
        shard, at = archive.shard_path(int(entry["shard"])), int(entry["frame_offset"][2]) + 9
    data = bytearray(shard.read_bytes())
    data[at] ^= 1
    shard.write_bytes(data)
    with pytest.raises(CorruptError):
        seal_archive(copy, KEY)
    assert not (copy / SEAL_NAME).exists()


def test_format_md_says_how_a_seal_is_made(sealed: Path) -> None:
    """Of the text: SHA-256 of frames, and HMAC-SHA256 over what is named there."""
    import hashlib
    import hmac

    index = read_index(sealed)
    from solidcloud.schemas.archive.index import index_digest

    text = b"solidcloud seal 1" + (5).to_bytes(4, "little") + index_digest(index.archive_id, index.columns)
    assert (sealed / SEAL_NAME).read_bytes() == hmac.new(KEY, text, hashlib.sha256).digest()
    with Archive(sealed) as archive:
        for row in range(len(archive.voxels)):
            cells, nodes, points = archive.read_frames(row)
            found = index.columns["record_digest"][row]
            assert found[0].tobytes() == hashlib.sha256(cells + nodes).digest()[:16]
            assert found[1].tobytes() == hashlib.sha256(points).digest()[:16]
