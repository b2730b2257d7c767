"""Hard cases of motions: grazes, long ways, what is missing; a test's number is its row in NUMERICS.md."""

import os
import subprocess
import sys
from pathlib import Path

import archive_cases
import judged_sweeps
import numpy as np
import pytest
import synthetic_scans
from sample_sizes import sample
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.errors import BadRequestError, BadTransformError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.queries.collide import collide
from solidcloud.server.queries.query_inputs import QueryBudget
from sweep_poses import at, turn_z

POINT = np.zeros((1, 3))
UNIT = 2.0**-26


@pytest.mark.case(
    26,
    "motions of 1 cm, 1 m, 100 m and 10 km: first contact within 1 µm of the truth; clear if it ends 0.1 mm short",
)
@pytest.mark.parametrize("length", [0.01, 1.0, 100.0, 10_000.0])
def test_case_26_ways_from_a_centimetre_to_ten_kilometres(tmp_path: Path, length: float) -> None:
    # Touches 0.3 m before the wall's point, at 7/8 of the way.
    case = archive_cases.build(tmp_path, POINT, radius=0.25, resolution=archive_cases.BINARY_STEP)
    first, last = at(-0.3 - length * 0.875), at(-0.3 + length * 0.125)
    turned = last.copy()
    turned[0, :3, :3] = turn_z(1.0)
    with judged_sweeps.opened(case) as data:
        for end in (last, turned):
            answers = judged_sweeps.ask(data, POINT, 0.05, first, end)
            if end is last:
                assert answers.exact[0] and abs(answers.upper[0] - 0.875) * length < 1e-6
                assert (answers.upper[0] - answers.lower[0]) * length <= 1e-6
                judged_sweeps.judge(case, data, POINT, 0.05, first, end, answers, samples=100)
            back = judged_sweeps.ask(data, POINT, 0.05, at(-length - 0.3001), at(-0.3001))
            assert back.verdict[0] == Verdict.CLEAR and back.lower[0] == 1 and back.upper[0] == np.inf


@pytest.mark.case(26, "a motion of length zero: the verdict of collide, exact to the unit")
def test_case_26_zero_motion_is_the_static_answer(tmp_path: Path, rng: np.random.Generator) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("plane", 1, 60), radius=0.0)
    body = rng.uniform(-0.2, 0.2, (8, 3))
    count = sample(30, 100)
    poses = archive_cases.near_poses(rng, case.points, body, 2 * count, 0.2)
    with judged_sweeps.opened(case) as data:
        origin = data.arrays.origin
        for pose in poses:
            least, _ = archive_cases.least_reach(case, body, pose, origin, 1e-4)
            for units in (least - 1, least):  # one unit apart, and one verdict
                if units < 0:
                    continue
                answers = judged_sweeps.ask(data, body, 0.0, pose[None], pose[None], margin=units * UNIT)
                static = collide(data, make_avatar(body, 0.0), pose[None], units * UNIT)
                assert answers.verdict.tolist() == static.verdict.tolist() == [int(units >= least)]
                assert answers.exact[0] and answers.outside.tolist() == static.outside.tolist()
                assert (answers.lower[0], answers.upper[0]) == (
                    (0.0, 0.0) if units >= least else (1.0, np.inf)
                )


@pytest.mark.case(26, "tangency, exact to the unit, at one end only: found")
def test_case_26_contact_at_the_very_end_and_at_the_very_beginning(tmp_path: Path) -> None:
    # Tangent, to the unit, at one end of the way and nowhere else.
    case = archive_cases.build(tmp_path, POINT, radius=0.25, resolution=archive_cases.BINARY_STEP)
    with judged_sweeps.opened(case) as data:
        there = judged_sweeps.ask(data, POINT, 0.5, at(2.0), at(0.75))
        short = judged_sweeps.ask(data, POINT, 0.5, at(2.0), at(0.75 + 4 * UNIT))
        away = judged_sweeps.ask(data, POINT, 0.5, at(0.75), at(2.0))
        clear = judged_sweeps.ask(data, POINT, 0.5, at(0.75 + 4 * UNIT), at(2.0))
    assert there.verdict[0] == Verdict.CONTACT and there.upper[0] == 1 and there.exact[0]
    assert 0 < (1 - there.lower[0]) * 1.25 <= 1e-6
    assert short.verdict[0] == clear.verdict[0] == Verdict.CLEAR
    assert away.verdict[0] == Verdict.CONTACT and away.lower[0] == away.upper[0] == 0 and away.exact[0]


@pytest.mark.case(26, "a grazing contact within rounding is unknown or found, never clear")
def test_case_26_a_graze_is_unknown_or_found_never_clear(tmp_path: Path) -> None:
    """Past a sphere by so many units: well apart is clear, well inside exact, between them nothing is claimed."""
    case = archive_cases.build(tmp_path, POINT, radius=0.25, resolution=archive_cases.BINARY_STEP)
    with judged_sweeps.opened(case) as data:
        for units, said, exact in (
            (-60_000, Verdict.CONTACT, True),
            (-10, Verdict.CONTACT, False),
            (0, Verdict.CONTACT, False),
            (0.6, Verdict.UNKNOWN, False),  # rounds to 1 unit apart, but lies within rounding of a touch
            (1, Verdict.CLEAR, True),
        ):
            first, last = at(-0.5, 0.75 + units * UNIT), at(0.5, 0.75 + units * UNIT)
            answers = judged_sweeps.ask(data, POINT, 0.5, first, last)
            assert answers.verdict[0] == said and answers.exact[0] == exact, units
            judged_sweeps.judge(case, data, POINT, 0.5, first, last, answers, samples=201)
            if said == Verdict.UNKNOWN:
                assert 0.499 < answers.lower[0] < 0.5
            assert answers.steps[0] < 100


@pytest.mark.case(26, "contact beyond an undecided grazing contact is found")
def test_case_26_contact_beyond_a_graze_is_found(tmp_path: Path) -> None:
    points = np.array([[0.0, 0, 0], [2.0, 0.5, 0]])
    case = archive_cases.build(tmp_path, points, radius=0.25, resolution=archive_cases.BINARY_STEP)
    first, last = at(-1.0, 0.75 + 0.6 * UNIT), at(3.0, 0.75 + 0.6 * UNIT)
    with judged_sweeps.opened(case) as data:
        answers = judged_sweeps.ask(data, POINT, 0.5, first, last)
        judged_sweeps.judge(case, data, POINT, 0.5, first, last, answers)
    assert answers.verdict[0] == Verdict.CONTACT and not answers.exact[0]
    assert answers.lower[0] < 0.25 < 0.5 < answers.upper[0]


@pytest.mark.case(
    26,
    "rotations in place up to half a turn: the judge's answers, none unknown",
)
def test_case_26_turns_alone(tmp_path: Path, rng: np.random.Generator) -> None:
    """A rod that turns about one end, up to half a turn, against pillars around it."""
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("pillar", 5, 400), radius=0.01)
    rod = np.linspace(0, 0.6, 40)[:, None] * [1.0, 0, 0]
    count = sample(20, 60)
    first = np.array(
        [archive_cases.pose_of(turn_z(a), np.array([0.5, 1.0, 1.0])) for a in rng.uniform(0, 7, count)]
    )
    last = first.copy()
    for i, angle in enumerate([*rng.uniform(-3, 3, count - 4), np.pi, -np.pi, np.pi - 1e-9, np.pi - 1e-15]):
        last[i, :3, :3] = turn_z(angle) @ first[i, :3, :3]
    with judged_sweeps.opened(case) as data:
        answers = judged_sweeps.ask(data, rod, 0.005, first, last)
        judged_sweeps.judge(case, data, rod, 0.005, first, last, answers)
    assert count / 6 < (answers.verdict == Verdict.CONTACT).sum() < count - 5
    assert (answers.verdict != Verdict.UNKNOWN).all() and answers.exact.all()


@pytest.mark.case(
    23,
    "a motion through over 8 times the cache: the bounds of a large cache; voxels beyond contact are not loaded",
)
def test_case_23_a_way_through_more_than_the_cache_holds(tmp_path: Path, rng: np.random.Generator) -> None:
    """Segment by segment, and a segment piece by piece; what lies beyond the contact is never loaded."""
    points = rng.uniform(0, 1, (sample(3000, 6000), 3)) * [60.0, 2, 2]
    points = points[(np.abs(points[:, 1:] - 1).max(axis=1) > 0.3) | (points[:, 0] > 50)]
    case = archive_cases.build(tmp_path, points, voxel=1.0, radius=0.05)
    body = rng.uniform(-0.1, 0.1, (10, 3))
    first, last = at(-1.0, 1.0, 1.0), at(61.0, 1.0, 1.0)
    last[0, :3, :3] = turn_z(0.02)
    with judged_sweeps.opened(case) as data:
        wide = judged_sweeps.ask(data, body, 0.02, first, last)
        loaded = data.residency.stats.misses
        judged_sweeps.judge(case, data, body, 0.02, first, last, wide)
    assert wide.verdict[0] == Verdict.CONTACT and 0.7 < wide.upper[0] < 0.9
    with Archive(case.archive) as archive:
        voxels = len(archive.voxels)
    largest = 1 << 12
    with judged_sweeps.opened(case, largest) as data:
        assert data.residency.bytes_of(range(voxels)) > 8 * largest
        tight = judged_sweeps.ask(data, body, 0.02, first, last)
    assert (tight.lower[0], tight.upper[0]) == (wide.lower[0], wide.upper[0]) and tight.exact[0]
    with judged_sweeps.opened(case) as data:
        found = judged_sweeps.ask(data, body, 0.02, last, at(-1.0, 1.0, 1.0))
        assert found.verdict[0] == Verdict.CONTACT and found.upper[0] < 0.2
        assert data.residency.stats.misses < 0.6 * loaded


@pytest.mark.case(21, "voxels that cannot be read: unknown from there on along the motion, exact before")
def test_case_21_what_is_missing_is_unknown_from_there_on(tmp_path: Path, rng: np.random.Generator) -> None:
    points = np.concatenate(
        [rng.uniform(0, 0.4, (40, 3)), rng.uniform([2.0, 0, 0], [2.4, 0.4, 0.4], (40, 3))]
    )
    case = archive_cases.build(tmp_path, points, voxel=0.5, radius=0.01)
    with Archive(case.archive) as archive:
        lattice = archive.header.lattice
        beyond = np.flatnonzero(
            lattice.to_world(archive.coordinates * lattice.voxel_steps)[:, 0] > 1
        ).tolist()
    with judged_sweeps.opened(case) as data:
        clear = judged_sweeps.ask(data, POINT, 0.01, at(-1, -0.2, 0.2), at(4, -0.2, 0.2))
        assert clear.verdict[0] == Verdict.CLEAR and clear.outside[0]
        load = data.residency._store.load

        def broken(row: int, *rest: object) -> object:
            if row in beyond:
                raise OSError("taken away")
            return load(row, *rest)

        data.residency._store.load = broken  # type: ignore[method-assign]
        assert not data.residency.resident
        # Past it within reach: its points are at x 2 to 2.4.
        beside = judged_sweeps.ask(data, POINT, 0.01, at(-1, 0.2, 0.6), at(4, 0.2, 0.6), margin=0.3)
        through = judged_sweeps.ask(data, POINT, 0.01, at(1, 0.2, 0.2), at(4, 0.2, 0.2), margin=0.3)
        before = judged_sweeps.ask(data, POINT, 0.01, at(-1, 0.2, 0.2), at(4, 0.2, 0.2), margin=0.3)
        after = judged_sweeps.ask(data, POINT, 0.01, at(4, 0.2, 0.2), at(-1, 0.2, 0.2), margin=0.3)
        apart = judged_sweeps.ask(data, POINT, 0.01, at(-1, -0.2, 0.2), at(1.0, -0.2, 0.2))
    assert beside.verdict[0] == Verdict.CONTACT
    assert through.verdict[0] == Verdict.UNKNOWN and through.voxels_missing[0] >= 1 and through.faults
    # Their box says where points begin.
    met = (points[40:, 0].min() - 0.32 - 1) / 3
    assert met - 1e-3 < through.lower[0] <= met + 1e-4
    assert before.verdict[0] == Verdict.CONTACT and before.exact[0] and before.upper[0] < 0.3
    assert after.verdict[0] == Verdict.CONTACT and not after.exact[0]
    assert after.lower[0] <= (4 - 2.3 - 0.32) / 5 < after.upper[0]
    assert apart.verdict[0] == Verdict.CLEAR and apart.voxels_missing[0] == 0


@pytest.mark.case(21, "regions of scans left out: unknown from there on along the motion")
def test_case_21_regions_of_scans_left_out(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, POINT, radius=0.25, resolution=archive_cases.BINARY_STEP)
    box = np.array([[[2.0, -1, -1], [3.0, 1, 1]]])
    with judged_sweeps.opened(case) as data:
        steps = np.rint((box - data.arrays.origin) / data.arrays.step).astype(np.int64)
        tree = data.tree._replace(unknown=steps.astype(np.float64))
        partly = data._replace(tree=tree)
        nowhere = data._replace(unknown_everywhere=True)
        reached = (
            judged_sweeps.ask(partly, POINT, 0.5, at(6.0, 1.5), at(1.0, 1.5)),
            judged_sweeps.ask(partly, POINT, 0.5, at(6.0), at(-6.0)),
        )
        before = judged_sweeps.ask(partly, POINT, 0.5, at(-2.0), at(2.0))
        beside = judged_sweeps.ask(partly, POINT, 0.5, at(6.0, 4.0), at(-6.0, 4.0))
        lost = judged_sweeps.ask(nowhere, POINT, 0.5, at(6.0, 4.0), at(-6.0, 4.0))
        found = judged_sweeps.ask(nowhere, POINT, 0.5, at(6.0), at(-6.0))
    assert reached[0].verdict[0] == Verdict.UNKNOWN
    assert abs(reached[0].lower[0] * 5 - 2.25) < 0.02
    assert reached[1].verdict[0] == Verdict.CONTACT and not reached[1].exact[0]
    assert abs(reached[1].lower[0] * 12 - 2.25) < 0.02 and abs(reached[1].upper[0] * 12 - 5.25) < 1e-5
    assert before.verdict[0] == Verdict.CONTACT and before.exact[0]
    assert beside.verdict[0] == Verdict.CLEAR
    assert lost.verdict[0] == Verdict.UNKNOWN and lost.lower[0] == 0
    assert found.verdict[0] == Verdict.CONTACT and found.lower[0] == 0 and not found.exact[0]


@pytest.mark.case(3, "motions that change size or shear, and unequal numbers of ends, are refused")
def test_case_03_motions_that_change_size_are_refused(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, POINT, radius=0.25)
    grown, nearly, sheared = at(1.0), at(1.0), at(1.0)
    grown[0, :3, :3] *= 1.001
    nearly[0, :3, :3] *= 1 + 0.4e-9
    sheared[0, 0, 1] = 0.1
    with judged_sweeps.opened(case) as data:
        with pytest.raises(BadTransformError, match=r"pose 0 scales by 1\.001"):
            judged_sweeps.ask(data, POINT, 0.5, at(2.0), grown)
        with pytest.raises(BadTransformError, match="shears"):
            judged_sweeps.ask(data, POINT, 0.5, sheared, at(2.0))
        with pytest.raises(BadRequestError, match="1 poses to begin at and 2 to end at"):
            judged_sweeps.ask(data, POINT, 0.5, at(2.0), np.concatenate([at(1.0), at(0.0)]))
        for bad in (np.nan, -1.0, np.inf):
            with pytest.raises(BadRequestError):
                judged_sweeps.ask(data, POINT, 0.5, at(2.0), at(1.0), tolerance=bad)
        assert judged_sweeps.ask(data, POINT, 0.5, at(2.0), nearly).verdict[0] == Verdict.CLEAR
        assert len(judged_sweeps.ask(data, POINT, 0.5, at(0.0)[:0], at(0.0)[:0])) == 0
        empty = judged_sweeps.ask(data, np.empty((0, 3)), 0.5, at(2.0), at(-2.0))
        assert empty.verdict[0] == Verdict.CLEAR and empty.lower[0] == 1


@pytest.mark.case(30, "a tolerance widens the interval of a sweep and changes no verdict")
def test_case_30_a_tolerance_widens_the_interval_and_no_more(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("corner", 2, 60), radius=0.01)
    body = rng.uniform(-0.1, 0.1, (6, 3))
    count = 40
    first = archive_cases.near_poses(rng, case.points, body, count, 0.4)
    last = archive_cases.near_poses(rng, case.points, body, count, 0.2)
    with judged_sweeps.opened(case) as data:
        fine = judged_sweeps.ask(data, body, 0.01, first, last)
        for tolerance in (1e-4, 1e-2):
            coarse = judged_sweeps.ask(data, body, 0.01, first, last, tolerance=tolerance)
            same = judged_sweeps.ask(data, body, 0.01, first, last, budget=QueryBudget(tolerance=tolerance))
            assert coarse.lower.tolist() == same.lower.tolist()
            assert coarse.verdict.tolist() == fine.verdict.tolist()
            assert (coarse.lower <= fine.upper).all() and (fine.lower <= coarse.upper).all()
            assert coarse.steps.sum() <= fine.steps.sum()
            judged_sweeps.judge(case, data, body, 0.01, first, last, coarse, tolerance=tolerance, samples=20)


SCRIPT = """
import pathlib, sys, archive_cases, numpy as np, synthetic_scans, judged_sweeps
rng = np.random.default_rng(5)
case = archive_cases.Case(pathlib.Path(sys.argv[1]), np.empty((0, 3)))
body = rng.uniform(-0.1, 0.1, (4, 3))
corner = synthetic_scans.make_scan("corner", 2, 60)
first, last = (archive_cases.near_poses(rng, corner, body, 6, 0.3) for _ in range(2))
with judged_sweeps.opened(case) as data:
    found = judged_sweeps.ask(data, body, 0.01, first, last)
print([column.tobytes().hex() for column in (found.verdict, found.lower, found.upper, found.witness_avatar)])
"""


@pytest.mark.case(24, "bounds and witnesses of sweeps equal the interpreter's")
def test_case_24_compiled_and_interpreted_agree_bit_for_bit(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, synthetic_scans.make_scan("corner", 2, 60), radius=0.01)
    path = os.pathsep.join([str(Path(judged_sweeps.__file__).parent), os.environ.get("PYTHONPATH", "")])
    said = [
        subprocess.run(
            [sys.executable, "-W", "ignore", "-c", SCRIPT, str(case.archive)],
            env=os.environ | {"PYTHONPATH": path, "NUMBA_DISABLE_JIT": disabled},
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for disabled in ("0", "1")
    ]
    assert said[0] == said[1] and len(said[0]) > 100
