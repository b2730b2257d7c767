"""Opening an archive without the points in boxes: what is read, what fails, what is refused, what is corrupt."""

import os
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
from masked_scans import BODY, DOOR, build, open_without, two_scans
from numpy.typing import NDArray
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import BadRequestError, BadTransformError, SolidcloudError
from solidcloud.schemas.scene.effect_table import ThroughBox
from solidcloud.server.archives import masked_archive as left_out
from solidcloud.server.scene import Scene


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The archive of all points."""
    return build(tmp_path_factory.mktemp("left_out") / "whole", two_scans())


def corrupt(archive: Path, place: NDArray[np.float64]) -> str:
    """Flip a byte of the points of the voxel that holds a place; returns how messages name the voxel."""
    with Archive(archive) as opened:
        voxel = (place // 0.5).astype(int)
        row = int(np.flatnonzero((opened.coordinates == voxel).all(axis=1))[0])
        entry = opened.voxels[row]
        path = opened.shard_path(int(entry["shard"]))
    with open(path, "r+b") as file:
        offset = int(entry["frame_offset"][2]) + int(entry["frame_bytes"][2]) // 2
        byte = os.pread(file.fileno(), 1, offset)[0]
        os.pwrite(file.fileno(), bytes([byte ^ 0x10]), offset)
    return f"voxel ({', '.join(map(str, voxel.tolist()))})"


def test_a_corrupt_record_in_a_box_says_so_and_is_unknown(tmp_path: Path) -> None:
    archive = build(tmp_path / "own", two_scans())
    place = np.array([0.25, 0.75, 0.75])
    named = corrupt(archive, place)
    pose = archive_cases.pose_of(np.eye(3), place)[None]
    with open_without(archive, DOOR) as scene, Scene.open(archive) as plain:
        answers = []
        for each in (scene, plain):
            each.add_avatar("ball", [[0.0, 0, 0]], 0.01)
            answers.append(each.collide("ball", pose))
        assert answers[0].verdict.tolist() == [2]
        # What zstandard says of it depends on which columns were read; where it lies, and what to do, does not.
        said = [answer.faults[0].partition(" (decompression")[0].partition(" (zstd")[0] for answer in answers]
        assert said[0] == said[1]
        assert named in said[0] and said[0].endswith("damaged frame")
        assert "restore the shard or rebuild the archive" in answers[0].faults[0]
        # Mended, it is not served with the points in the box; a reload serves it without.
        corrupt(archive, place)
        assert scene.collide("ball", pose).verdict.tolist() == [2]
        scene.reload()
        assert scene.collide("ball", pose).verdict.tolist() != [2]
        scene.residency.check()


def test_boxes_that_hold_everything_are_refused(whole: Path) -> None:
    with pytest.raises(BadRequestError, match="contain all of its points: leave the archive out"):
        open_without(whole, ThroughBox("all", (0.0, 0.0, 0.0), (2.0, 2.0, 2.0)))


@pytest.mark.parametrize(
    ("pose", "said"),
    [
        (np.diag([2.0, 2, 2, 1]), "not rigid"),
        (np.diag([-1.0, 1, 1, 1]), "not rigid"),
        (np.eye(4) * np.nan, "finite"),
        (np.eye(3), r"shape \(3, 3\)"),
        (archive_cases.pose_of(np.eye(3), np.array([2e9, 0, 0])), "within 1e9 m"),
    ],
)
def test_a_pose_that_is_not_rigid_is_refused(whole: Path, pose: NDArray[np.float64], said: str) -> None:
    error = BadTransformError if said == "not rigid" else BadRequestError
    with pytest.raises(error, match=said):
        open_without(whole, DOOR, pose=pose)


@pytest.mark.parametrize(
    ("fails", "said"),
    [
        (
            "pwrite_all",
            ": No space left on device: rebuilt voxels of the effect `through` are stored there: free disk",
        ),
        ("read_points", r"voxel \(.*\): cannot be read \(No space left on device\)"),
    ],
)
def test_what_fails_while_it_is_opened_is_told_and_leaves_no_file_open(
    whole: Path, monkeypatch: pytest.MonkeyPatch, fails: str, said: str
) -> None:
    def full(*_: Any) -> None:
        raise OSError(28, "No space left on device")

    before = len(os.listdir("/proc/self/fd"))
    with open_without(whole, DOOR) as scene:
        scene.add_avatar("al", BODY, 0.02)
        within = len(os.listdir("/proc/self/fd"))
        monkeypatch.setattr(left_out, fails, full)
        with pytest.raises(SolidcloudError, match=said):
            open_without(whole, DOOR)
        with pytest.raises(SolidcloudError, match=said):
            scene.reload()
        # What was served is served on.
        assert len(os.listdir("/proc/self/fd")) == within
        assert len(scene.collide("al", np.eye(4)[None])) == 1
    assert len(os.listdir("/proc/self/fd")) == before
