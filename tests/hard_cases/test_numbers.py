"""Hard cases of numbers: large, small, near-tangent, not finite; a test's number is its row in NUMERICS.md."""

import math
from fractions import Fraction
from pathlib import Path

import archive_cases
import naive
import naive_distance
import naive_rays
import numpy as np
import pytest
import synthetic_scans
from sample_sizes import sample
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.pipeline import build_archive
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import BadRequestError, BadTransformError, ScanError
from solidcloud.server.scene import Scene

POINT = np.zeros((1, 3))


@pytest.mark.case(
    1, "moved by 5.6e6, 6.4e6 and 1e8 m: index and verdicts equal those at the origin, and the judge's"
)
@pytest.mark.parametrize(
    "shift", [(500_000, 5_600_000, 100), (4_027_894, 307_045, 4_919_475), (-(10**8), 10**8, 7)]
)
def test_case_01_map_coordinates_answer_as_the_origin_does(
    tmp_path: Path, rng: np.random.Generator, shift: tuple[int, int, int]
) -> None:
    # Millimetres as multiples of 2^-10 m, so that the shift is exact; float32 would keep 3 of 1,000 there.
    line = np.arange(60.0)[:, None] * [archive_cases.BINARY_STEP, 0, 0]
    avatar = np.rint(rng.uniform(-0.1, 0.1, (6, 3)) * 2.0**20) * 2.0**-20
    poses = archive_cases.near_poses(rng, line, avatar, 12, 0.02)
    poses[:, :3, 3] = np.rint(poses[:, :3, 3] * 2.0**20) * 2.0**-20
    moved = poses.copy()
    moved[:, :3, 3] += shift
    options = {"resolution": archive_cases.BINARY_STEP, "radius": 0.002, "voxel": 0.0625, "leaf": 4}
    near, far = (
        archive_cases.build(tmp_path, line, **options),
        archive_cases.build(tmp_path, line + shift, **options),
    )
    with Archive(near.archive) as one, Archive(far.archive) as other:
        assert (np.array(other.header.lattice.origin) - one.header.lattice.origin).tolist() == list(shift)
        for column in ("key", "low", "high", "rows", "leaves"):
            assert (one.voxels[column] == other.voxels[column]).all()
        assert other.header.points == 60 and other.header.moved_max == 0.0
    for margin in (0.0, 0.004):
        verdicts = archive_cases.ask(near, avatar, 0.003, poses, margin)
        assert verdicts.tolist() == archive_cases.ask(far, avatar, 0.003, moved, margin).tolist()
        assert verdicts.tolist() == far.judge(avatar, 0.003, moved, margin).astype(int).tolist()


@pytest.mark.case(3, "scale, shear, mirror and 1e-6 of stretch are refused")
def test_case_03_a_pose_that_is_not_rigid_is_refused(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, POINT, radius=0.25, resolution=archive_cases.BINARY_STEP)
    # Column norms are no bound: these two columns are of length 1 and 1.414, the stretch is 1.618.
    sheared, mirrored = np.eye(4), np.diag([1.0, 1, -1, 1])
    sheared[0, 1] = 1.0
    for pose in (sheared, mirrored, np.diag([1.0, 1.0, 1.0 + 1e-6, 1.0]), np.diag([2.0, 2.0, 2.0, 1.0])):
        with pytest.raises(BadTransformError):
            archive_cases.ask(case, POINT, 0.5, pose[None])


@pytest.mark.case(
    6,
    "10,000 pairs within 3 units of 15 nm of tangency at UTM coordinates: none wrong; plain float64 gets some wrong",
)
def test_case_06_near_tangent_pairs_are_decided_exactly(tmp_path: Path, rng: np.random.Generator) -> None:
    count = sample(1_000, 10_000)
    case = archive_cases.build(tmp_path, np.array([[5e5, 5.6e6, 0.0]]), radius=0.3)
    avatar = np.array([[0.7, -1.1, 0.4]])
    away = rng.normal(size=(count, 3))
    away *= 0.5 / np.linalg.norm(away, axis=1)[:, None]
    poses = np.array(
        [archive_cases.pose_of(archive_cases.random_rotation(rng), np.zeros(3)) for _ in range(count)]
    )
    # Placed within a few units of 2^-26 m of tangency; placing rounds at 5.6e6 m by 1e-9 m more.
    poses[:, :3, 3] = case.points[0] + away - np.einsum("kij,j->ki", poses[:, :3, :3], avatar[0])
    poses[:, :3, 3] += rng.integers(-3, 4, (count, 3)) * 2.0**-26
    expected = case.judge(avatar, 0.2, poses)
    assert archive_cases.ask(case, avatar, 0.2, poses).tolist() == expected.astype(int).tolist()
    # That the pairs are as near as meant: float64, well meant, gets some of them wrong.
    placed = np.einsum("kij,j->ki", poses[:, :3, :3], avatar[0]) + (poses[:, :3, 3] - case.points[0])
    assert ((placed**2).sum(axis=1) <= (0.3 + 0.2) ** 2).tolist() != expected.tolist()
    assert 0.3 < expected.mean() < 0.7


@pytest.mark.case(
    14,
    "NaN, infinities, 1e300 and 1.1e9 m: left out of a scan and counted, an error with --strict; refused in requests",
)
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf, 1e300, 1.1e9])
def test_case_14_what_is_not_finite_reaches_no_kernel(tmp_path: Path, bad: float) -> None:
    points = np.concatenate(
        [synthetic_scans.make_scan("plane", 1, 20), np.full((2, 3), bad), [[bad, 0.0, 0.0]]]
    )
    reason = "beyond 1e9 m" if np.isfinite(bad) else "not finite"
    case = archive_cases.build(tmp_path, points)
    with Archive(case.archive) as archive:
        assert archive.header.points == 20 and archive.header.sources[0].skipped == {reason: 3}
        assert np.isfinite(archive.header.lattice.origin).all()
    scan = synthetic_scans.write_ply(tmp_path / "strict.ply", points)
    with pytest.raises(ScanError, match=rf"3 points (that are )?{reason}"):
        build_archive([scan], tmp_path / "strict", BuildConfig(strict=True, jobs=1))
    with Scene.open(case.archive) as scene:
        scene.add_avatar("ball", POINT, 0.1)
        pose = np.eye(4)
        pose[0, 3] = bad
        for poses, margin in ((pose[None], 0.0), (np.eye(4)[None], bad)):
            with pytest.raises(BadRequestError):
                scene.collide("ball", poses, margin)
        with pytest.raises(BadRequestError):
            scene.add_avatar("wide", np.array([[bad, 0.0, 0.0]]), 0.1)
        if not math.isfinite(bad):
            with pytest.raises(BadRequestError):
                scene.add_avatar("thick", POINT, bad)


@pytest.mark.case(
    15, "radii of 0 and denormal radii give contact where the integers coincide; negative ones are refused"
)
def test_case_15_radii_of_zero_and_less(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, POINT, radius=0.0)
    unit = 2.0**-26
    poses = np.array(
        [archive_cases.pose_of(np.eye(3), np.array([x, 0, 0])) for x in (0.0, 0.4 * unit, unit, 1e-9)]
    )
    for radius in (0.0, 5e-324, 1e-300, 0.49 * unit):
        # All of these are 0 units: contact is where the integers coincide, and nowhere else.
        assert archive_cases.ask(case, POINT, radius, poses).tolist() == [1, 1, 0, 1]
    assert archive_cases.ask(case, POINT, 0.51 * unit, poses).tolist() == [1, 1, 1, 1]
    for negative in (-5e-324, -0.1):
        with pytest.raises(BadRequestError):
            archive_cases.ask(case, POINT, negative, poses)
        with pytest.raises(BadRequestError):
            archive_cases.ask(case, POINT, 0.0, poses, negative)
    with pytest.raises(BadRequestError, match="--radius"):
        archive_cases.build(tmp_path, POINT, radius=-0.1)


@pytest.mark.case(
    16, "scan points at the corners of 1e9 m: the judge's verdicts, to a micrometre of 16 m reach"
)
def test_case_16_coordinates_up_to_their_bound_overflow_nothing(tmp_path: Path) -> None:
    corners = np.array([[-1e9, -1e9, -1e9], [1e9, 1e9, 1e9], [1e9, -1e9, 0.0]])
    case = archive_cases.build(tmp_path, corners, voxel=2000.0, resolution=1e-3, radius=8.0)
    # 2 * 10^9 m from the origin float64 rounds a lattice point by up to 8 units of the definition, 0.12 um.
    at = np.concatenate([corners, corners - np.sign(corners + 1) * [15.75, 0, 0], corners * [0.5, 1, 1]])
    at = np.concatenate([at, corners - np.sign(corners + 1) * [16.0 + 1e-6, 0, 0]])
    poses = np.array([archive_cases.pose_of(np.eye(3), place) for place in at])
    expected = case.judge(POINT, 8.0, poses)
    assert expected.tolist() == [True] * 6 + [False] * 6
    assert archive_cases.ask(case, POINT, 8.0, poses).tolist() == expected.astype(int).tolist()


@pytest.mark.case(
    17,
    "a² - 2ab + b² in float64 at UTM: over a tenth negative, over a tenth of verdicts wrong; of ours none",
)
def test_case_17_the_expanded_square_is_not_what_decides(tmp_path: Path, rng: np.random.Generator) -> None:
    count = 2000
    base = np.array([5e5, 5.6e6, 100.0])
    case = archive_cases.build(tmp_path, base[None], radius=0.01, resolution=archive_cases.BINARY_STEP)
    away = rng.normal(size=(count, 3))
    away *= (rng.uniform(0.001, 0.06, count) / np.linalg.norm(away, axis=1))[:, None]
    poses = np.array([archive_cases.pose_of(np.eye(3), base + a) for a in away])
    a, b = poses[:, :3, 3], case.points[0]
    expanded = (a * a).sum(axis=1) - 2 * (a @ b) + b @ b
    truth = case.judge(POINT, 0.02, poses)
    assert (expanded < 0).mean() > 0.1 and ((expanded <= 0.03**2) != truth).mean() > 0.1
    with Scene.open(case.archive) as scene:
        scene.add_avatar("ball", POINT, 0.02)
        assert scene.collide("ball", poses).verdict.tolist() == truth.astype(int).tolist()
        near, within = scene.distance("ball", poses, 0.2), scene.within(a, 0.2)
        info = scene.info()
    scan = (case.points, info.origin, info.lattice_step)
    judged = naive_distance.distance(*scan, info.radius, POINT, 0.02, poses, 0.2)
    assert near.signed_distance.tolist() == [found.signed for found in judged if found]
    assert within.distance.tolist() == naive_rays.within(*scan, a, 0.2).distance.tolist()
    assert 0.3 < truth.mean() < 0.7


@pytest.mark.case(
    19,
    "against the points as delivered, in fractions: early or late by at most the band, with it as margin never late",
)
def test_case_19_the_lattice_moves_contact_by_its_declared_band(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    step = 0.01
    case = archive_cases.build(
        tmp_path, synthetic_scans.make_scan("noise", 3, 150), resolution=step, radius=0.05
    )
    avatar = rng.uniform(-0.2, 0.2, (5, 3))
    poses = archive_cases.near_poses(rng, case.points, avatar, 150, 0.14)
    with Scene.open(case.archive) as scene:
        info = scene.info()
        # Farthest a point moved along an axis; in all, and with the rounding to exact units.
        band = info.moved_max * math.sqrt(3) + 4 * 2.0**-26
        assert info.moved_max <= step / 2 * 1.0000001
        scene.add_avatar("avatar", avatar, 0.05)
        plain = scene.collide("avatar", poses).verdict
        generous = scene.collide("avatar", poses, band).verdict
    reach = Fraction(0.1)
    for pose, verdict, wide in zip(poses, plain, generous, strict=True):
        placed = avatar @ pose[:3, :3].T + pose[:3, 3]
        i, j = divmod(int(((placed[:, None] - case.points) ** 2).sum(axis=2).argmin()), len(case.points))
        square = sum((Fraction(a) - Fraction(b)) ** 2 for a, b in zip(placed[i], case.points[j], strict=True))
        if square <= (reach - Fraction(band)) ** 2:
            assert verdict == 1
        if square > (reach + Fraction(band)) ** 2:
            assert verdict == 0
        if square <= reach**2:
            assert wide == 1, "with the band as margin no contact of the source's points is missed"
    assert 20 < plain.sum() < 130


@pytest.mark.case(16, "a reach of 2^30 units is accepted, more is refused")
def test_case_16_reach_is_bounded_so_that_squares_fit(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, POINT, radius=8.0, resolution=1e-2, voxel=8.0)
    diagonal = np.full(3, 16.0 / math.sqrt(3))
    poses = np.array([archive_cases.pose_of(np.eye(3), diagonal * f) for f in (1 - 1e-7, 1 + 1e-7)])
    assert archive_cases.ask(case, POINT, 8.0, poses).tolist() == [1, 0]
    assert naive.reach_units(8.0, 8.0, 0.0) == 1 << 30
    with pytest.raises(BadRequestError, match="at most 16 m"):
        archive_cases.ask(case, POINT, 8.0 + 2.0**-26, poses)
