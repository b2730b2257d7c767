"""Test the lattice step of scans: by the closest points, whatever the format and order (issue 35, row 24)."""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import solidcloud
from numpy.typing import NDArray
from scan_formats import cartesian, glb_document, glb_vertices, ptx_scan, write_e57, write_glb, write_pcd
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.edit.edit_archive import add_scans
from solidcloud.builder.passes import survey_pass
from solidcloud.builder.pipeline import BuildSummary, build_archive
from solidcloud.builder.plan.scan_sample import plan_build
from solidcloud.builder.sources.scan_files import inspect_scans
from synthetic_scans import write_ply, write_xyz

COUNT = 4000
LIGHT = np.zeros(COUNT)


def tooth(radius: float = 0.5e-3, seed: int = 0) -> NDArray[np.float64]:
    """Return points (COUNT, 3) [m] on a ball, in random order: 14 µm apart with the default radius."""
    ball = np.random.default_rng(seed).normal(size=(COUNT, 3))
    return np.round(ball / np.linalg.norm(ball, axis=1)[:, None] * radius, 8)


def distances(points: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distance [m] of each of `points` to the closest distinct one of `others`, by brute force."""
    found = []
    for point in points:
        apart = np.linalg.norm(others - point, axis=1)
        found.append(apart[apart > 0].min())
    return np.array(found)


def las(path: Path, xyz: NDArray[np.float64], scale: float) -> Path:
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales = np.full(3, scale)
    file = laspy.LasData(header)
    file.xyz = xyz
    file.write(path)
    return path


def stl(path: Path, xyz: NDArray[np.float64]) -> Path:
    corners = np.repeat(xyz, 3, axis=0).reshape(-1, 9).astype("<f4")
    triangles = b"".join(bytes(12) + row.tobytes() + bytes(2) for row in corners)
    path.write_bytes(bytes(80) + struct.pack("<I", len(corners)) + triangles)
    return path


def text(path: Path, content: str) -> Path:
    path.write_text(content)
    return path


FORMATS: dict[str, Callable[[Path, NDArray[np.float64]], Any]] = {
    "xyz": write_xyz,
    "ply": write_ply,
    "pcd": lambda path, xyz: write_pcd(path, xyz, LIGHT, "binary"),
    "packed.pcd": lambda path, xyz: write_pcd(path, xyz, LIGHT, "binary_compressed"),
    "e57": lambda path, xyz: write_e57(path, [{"columns": cartesian(xyz)}]),
    "ptx": lambda path, xyz: text(path, ptx_scan(xyz, LIGHT)),
    "stl": stl,
    "obj": lambda path, xyz: text(path, "".join("v {:.8f} {:.8f} {:.8f}\n".format(*row) for row in xyz)),
    "glb": lambda path, xyz: write_glb(path, glb_document(COUNT), glb_vertices(xyz)),
}


def build(paths: list[Path], target: Path, **options: Any) -> BuildSummary:
    return build_archive(paths, target, BuildConfig(jobs=1, **options))


@pytest.mark.parametrize("name", FORMATS)
def test_fine_points_of_every_format_get_a_fine_lattice_and_true_distances(name: str, tmp_path: Path) -> None:
    xyz = tooth()
    scan = tmp_path / f"tooth.{name}"
    FORMATS[name](scan, xyz)
    if name == "glb":  # stored with y up
        xyz = xyz[:, [0, 2, 1]] * [1, -1, 1]
    summary = build([scan], tmp_path / "a")
    assert (summary.lattice_step, summary.lattice_source, summary.warnings) == (1e-6, "default", ())
    half = distances(xyz, xyz).mean() / 2
    assert summary.radius == pytest.approx(half, abs=1e-7)
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 0, 3] = np.linspace(0.55e-3, 0.8e-3, 5)
    with solidcloud.open(tmp_path / "a") as scene:
        scene.add_avatar("tip", np.zeros((1, 3)), 1e-5)
        found = scene.distance("tip", poses).signed_distance
    assert found == pytest.approx(distances(poses[:, :3, 3], xyz) - 1e-5 - half, abs=1.5e-6)


def test_points_on_a_grid_of_a_millimetre_keep_the_default(tmp_path: Path) -> None:
    grid = np.stack(np.meshgrid(*[np.arange(60) * 1e-3] * 2, [0.1], indexing="ij"), -1).reshape(-1, 3)
    write_ply(tmp_path / "a.ply", grid + np.array([431.7, 12.9, 0.0]))
    assert build([tmp_path / "a.ply"], tmp_path / "a").lattice_step == 1e-4


def test_the_step_is_not_that_of_duplicates_strays_or_few_dense_points(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)
    wall = np.column_stack([rng.uniform(0, 2, (3000, 2)), np.zeros(3000)])  # 18 mm apart
    twins = np.concatenate([wall, wall, wall + 1e-8, tooth()[:500]])
    write_ply(tmp_path / "wall.ply", rng.permutation(twins))
    assert build([tmp_path / "wall.ply"], tmp_path / "a").lattice_step == 1e-4
    write_ply(
        tmp_path / "tooth.ply", np.concatenate([tooth(), [[50.0, 0, 0]], tooth() + np.array([1, 2, 3])])
    )
    assert build([tmp_path / "tooth.ply"], tmp_path / "b").lattice_step == 1e-6


def test_the_step_is_that_of_the_densest_scan_however_the_work_is_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [write_ply(tmp_path / f"{k}.ply", tooth(radius, k)) for k, radius in enumerate([0.1, 1e-3])]
    assert build(files, tmp_path / "a", radius=0.001).lattice_step == 2e-6
    monkeypatch.setattr(survey_pass, "RANGE_POINTS", (300, 300))
    assert build(files[::-1], tmp_path / "b", radius=0.001).lattice_step == 2e-6


def test_a_step_that_is_stated_stays_and_is_called_too_coarse(tmp_path: Path) -> None:
    fine = write_xyz(tmp_path / "tooth.xyz", tooth())
    given = build([fine], tmp_path / "given", resolution=1e-4)
    assert (given.lattice_step, given.lattice_source) == (1e-4, "given")
    (warning,) = given.warnings
    assert warning.startswith(f"{fine}: points about 0.01")
    assert "in steps of 0.1 mm" in warning and "--resolution 1e-06" in warning
    (again,) = build([fine], tmp_path / "given", resolution=1e-4).warnings  # nothing is built
    assert "in steps of 0.1 mm" in again
    assert build([fine], tmp_path / "fine", resolution=2e-6).warnings == ()

    coarse = las(tmp_path / "tooth.las", tooth(), 1e-4)
    stated = build([coarse], tmp_path / "stated")
    assert (stated.lattice_step, stated.lattice_source) == (1e-4, "sources")
    (inspected,) = inspect_scans([coarse])
    for warnings in (
        stated.warnings,
        inspected.warnings,
        plan_build([coarse], BuildConfig(), tmp_path / "p").warnings,
    ):
        (warning,) = warnings
        assert "in steps of 0.1 mm" in warning and "export the scan with a finer scale" in warning

    wall = write_xyz(tmp_path / "wall.xyz", tooth(1.0))
    build([wall], tmp_path / "wall")
    (warning,) = add_scans(tmp_path / "wall", [fine], jobs=1).warnings
    assert "in steps of 0.1 mm" in warning and "build all scans with --resolution 1e-06" in warning
    assert (
        add_scans(tmp_path / "wall", [write_xyz(tmp_path / "more.xyz", tooth(1.0, 1))], jobs=1).warnings == ()
    )


@pytest.mark.parametrize("scale", [1e-6, 1e-3])
def test_a_step_that_a_file_states_is_kept_however_fine(scale: float, tmp_path: Path) -> None:
    scan = las(tmp_path / "a.las", tooth(0.1), scale)
    summary = build([scan], tmp_path / "a")
    assert (summary.lattice_step, summary.lattice_source, summary.warnings) == (scale, "sources", ())
    assert summary.moved_max < 1e-9


def test_files_with_unlike_steps_are_built_as_fine_as_their_points(tmp_path: Path) -> None:
    files = [las(tmp_path / "a.las", tooth(), 1e-6), las(tmp_path / "b.las", tooth() + 1, 2e-6)]
    assert build(files, tmp_path / "a").lattice_step < 1e-5
