"""`solidcloud.poses` against SciPy, values known by hand, and hard inputs."""

import itertools
import json
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from solidcloud import poses
from solidcloud.schemas.archive.rigid_pose import rigid_fault
from solidcloud.schemas.errors import BadRequestError, BadTransformError

Floats = NDArray[np.float64]
# A quarter turn about z: x to y, y to -x.
QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
# All sequences of axes that SciPy has: extrinsic and intrinsic, of one to three axes.
AXES = [
    "".join(each)
    for names in ("xyz", "XYZ")
    for count in (1, 2, 3)
    for each in itertools.product(names, repeat=count)
    if all(a != b for a, b in itertools.pairwise(each))
]


def pose_of(rotation: Any, translation: Any = (0.0, 0.0, 0.0)) -> Floats:
    """Return the poses of rotations and translations."""
    found = np.zeros((*np.shape(rotation)[:-2], 4, 4))
    found[..., :3, :3], found[..., :3, 3], found[..., 3, 3] = rotation, translation, 1.0
    return found


def random_poses(rng: np.random.Generator, count: int) -> Floats:
    return pose_of(Rotation.random(count, rng=rng).as_matrix(), rng.uniform(-1e3, 1e3, (count, 3)))


def off(found: Floats, expected: Floats) -> float:
    assert found.shape == expected.shape and found.dtype == np.float64 and found.flags.c_contiguous
    return float(np.abs(found - expected).max(initial=0.0))


def all_rigid(found: Floats, tolerance: float = 1e-14) -> bool:
    return all(rigid_fault(pose.tolist(), tolerance) is None for pose in found.reshape(-1, 4, 4))


def test_it_loads_numpy_alone() -> None:
    code = "import json, sys, solidcloud; solidcloud.poses.from_translation([1, 2, 3])"
    shown = "print(json.dumps([name for name in ('numba', 'scipy', 'h5py', 'zenoh') if name in sys.modules]))"
    done = subprocess.run(
        [sys.executable, "-P", "-c", f"{code}; {shown}"], capture_output=True, text=True, check=True
    )
    assert json.loads(done.stdout) == []


def test_a_translation_is_a_pose() -> None:
    assert off(poses.from_translation([1, 2, 3]), pose_of(np.eye(3), [1, 2, 3])) == 0.0
    many = [[1.0, 2, 3], [4, 5, 6]]
    assert off(poses.from_translation(many), pose_of(np.tile(np.eye(3), (2, 1, 1)), many)) == 0.0
    assert poses.from_translation(np.empty((0, 3))).shape == (0, 4, 4)


def test_quaternions_rotate_as_in_scipy(rng: np.random.Generator) -> None:
    given = Rotation.random(500, rng=rng)
    place = rng.normal(size=(500, 3))
    expected = pose_of(given.as_matrix(), place)
    for length in (1.0, 1e-3, 12.5):
        first = poses.from_quaternion(length * given.as_quat(), place, order="xyzw")
        last = poses.from_quaternion(length * given.as_quat(scalar_first=True), place, order="wxyz")
        assert off(first, expected) < 2e-15 and off(last, expected) < 2e-15
        assert all_rigid(first)
    # float32 quaternions give rotations that are exact to rounding, unlike float32 matrices.
    assert all_rigid(poses.from_quaternion(given.as_quat().astype(np.float32), order="xyzw"))


@pytest.mark.parametrize("axes", AXES)
def test_angles_rotate_as_in_scipy(axes: str, rng: np.random.Generator) -> None:
    angles = rng.uniform(-7, 7, (50, len(axes)))
    # Quarter and half turns, where two axes coincide (gimbal lock).
    angles[:20] = rng.integers(-4, 5, (20, len(axes))) * np.pi / 2
    expected = Rotation.from_euler(axes, angles).as_matrix().reshape(50, 3, 3)
    found = poses.from_euler(angles, (1, 2, 3), axes=axes)
    assert off(found, pose_of(expected, (1, 2, 3))) < 2e-15 and all_rigid(found)
    for one in (poses.from_euler(angles[7], axes=axes), poses.from_euler(angles[7:8], axes=axes)):
        assert np.array_equal(one.reshape(4, 4)[:3, :3], found[7, :3, :3])


def test_a_rotation_of_scipy_is_a_pose(rng: np.random.Generator) -> None:
    one, many = Rotation.from_euler("z", np.pi / 2), Rotation.random(5, rng=rng)
    assert off(poses.from_rotation(one, (1, 2, 3)), pose_of(QUARTER, (1, 2, 3))) < 1e-15
    assert off(poses.from_rotation(many), pose_of(many.as_matrix())) < 1e-15


@pytest.mark.parametrize(
    ("make", "one"),
    [
        (lambda rows, place: poses.from_quaternion(rows, place, order="wxyz"), (1.0, 2.0, 3.0, 4.0)),
        (lambda rows, place: poses.from_euler(rows, place, axes="xyz"), (0.1, 0.2, 0.3)),
        (lambda rows, place: poses.from_rotation(Rotation.from_rotvec(rows), place), (0.1, 0.2, 0.3)),
    ],
)
def test_one_of_either_goes_with_many_of_the_other(
    make: Callable[[Any, Any], Floats], one: tuple[float, ...]
) -> None:
    places = np.arange(9.0).reshape(3, 3)
    expected = [make(one, place) for place in places]
    assert np.array_equal(make(one, places), expected)
    assert np.array_equal(make([one] * 3, places), expected)
    assert np.array_equal(make([one] * 3, places[1]), [expected[1]] * 3)
    assert make([one], places[0]).shape == (1, 4, 4)
    with pytest.raises(BadRequestError, match="for 2 poses and translation for 3: expected equal numbers"):
        make([one] * 2, places)


NAN = float("nan")


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (
            lambda: poses.from_quaternion([1, 0, 0, 0], order="wzyx"),
            "order 'wzyx': expected 'xyzw' or 'wxyz'",
        ),  # type: ignore[arg-type]
        (lambda: poses.from_quaternion([0, 0, 0, 0], order="wxyz"), "quaternion is zero"),
        (lambda: poses.from_quaternion([[1, 0, 0, 0], [0, 0, 0, 0]], order="wxyz"), "quaternion 1 is zero"),
        (lambda: poses.from_quaternion([1, 0, NAN, 0], order="wxyz"), r"quaternion\[2\] is nan"),
        (lambda: poses.from_quaternion([[1, 0, 0, np.inf]], order="wxyz"), r"quaternion\[0, 3\] is inf"),
        (
            lambda: poses.from_quaternion([1, 0, 0], order="wxyz"),
            r"quaternion of shape \(3,\): expected \(4,\)",
        ),
        (lambda: poses.from_quaternion("1 0 0 0", order="wxyz"), "quaternion: "),
        (lambda: poses.from_quaternion([1, 0, 0, 0], [1, 2], order="wxyz"), r"translation of shape \(2,\)"),
        (lambda: poses.from_quaternion([1, 0, 0, 0], [1, 2, NAN], order="wxyz"), r"translation\[2\] is nan"),
        (lambda: poses.from_euler([0, 0, 0], axes="xYz"), "either small letters"),
        (lambda: poses.from_euler([0, 0, 0], axes="xxz"), "different axes"),
        (lambda: poses.from_euler([0, 0, 0], axes="xyw"), "one to three of xyz"),
        (lambda: poses.from_euler([0, 0, 0], axes=""), "one to three of xyz"),
        (
            lambda: poses.from_euler([0, 0], axes="xyz"),
            r"angles of shape \(2,\): expected \(3,\) or \(k, 3\)",
        ),
        (lambda: poses.from_euler([0, NAN, 0], axes="xyz"), r"angles\[1\] is nan"),
        (lambda: poses.from_translation([[1, 2]]), r"translation of shape \(1, 2\)"),
        (
            lambda: poses.from_rotation(np.eye(3)),
            "rotation of type ndarray: expected an object with as_matrix",
        ),
        (lambda: poses.renormalise(np.eye(3)), r"poses of shape \(3, 3\)"),
        (
            lambda: poses.renormalise(pose_of(np.eye(3), (NAN, 0, 0))),
            "pose 0 holds a number that is not finite",
        ),
    ],
)
def test_what_is_no_pose_is_refused(make: Callable[[], Any], said: str) -> None:
    with pytest.raises(BadRequestError, match=said):
        make()


def test_the_order_and_the_axes_must_be_named() -> None:
    with pytest.raises(TypeError, match="'order'"):
        poses.from_quaternion([1, 0, 0, 0])  # type: ignore[call-arg]
    with pytest.raises(TypeError, match="'axes'"):
        poses.from_euler([1, 0, 0])  # type: ignore[call-arg]


def test_float32_rotations_become_the_nearest_ones(rng: np.random.Generator) -> None:
    exact = random_poses(rng, 2000)
    rounded = exact.astype(np.float32)
    assert sum(rigid_fault(pose) is not None for pose in rounded.tolist()) > 1990, "or this shows nothing"
    found = poses.renormalise(rounded)
    assert all_rigid(found) and np.array_equal(found[:, :3, 3], rounded[:, :3, 3])
    assert np.abs(found - exact)[:, :3, :3].max() < 5e-8
    u, _, vt = np.linalg.svd(rounded[:, :3, :3].astype(np.float64))
    assert np.abs(found[:, :3, :3] - u @ vt).max() < 1e-14
    assert np.array_equal(poses.renormalise(rounded[17]), found[17]), "one at a time: the same bits"
    assert np.array_equal(poses.renormalise(found), found), "a second time it changes nothing"


def test_what_is_far_from_a_rotation_is_refused_with_the_distance(rng: np.random.Generator) -> None:
    turn = random_poses(rng, 1)[0]
    bent = turn.copy()
    bent[:3, :3] = turn[:3, :3] @ np.diag([1.01, 1.0, 0.99])
    with pytest.raises(
        BadTransformError, match=r"pose 1 is 0\.00\d+ from the nearest rotation: expected at most 0\.001"
    ):
        poses.renormalise([turn, bent])
    assert off(poses.renormalise(bent, within=0.02), turn) < 1e-14
    sheared = turn.copy()
    sheared[:3, :3] += rng.normal(scale=0.2, size=(3, 3))
    u, _, vt = np.linalg.svd(sheared[:3, :3])
    assert np.abs(poses.renormalise(sheared, within=2.0)[:3, :3] - u @ vt).max() < 1e-13


@pytest.mark.parametrize(
    ("rotation", "said"),
    [
        (np.diag([1.0, 1, -1]), "mirrors"),
        (-np.eye(3), "mirrors"),
        (np.zeros((3, 3)), "flattens"),
        (np.diag([1.0, 1, 0]), "flattens"),
        (np.ones((3, 3)), "flattens"),
        (2 * np.eye(3), "is 1 from the nearest rotation"),
        (1e-300 * np.eye(3), "flattens"),
        (np.diag([1e300, 1, 1]), "holds 1e.300: expected a rotation"),
    ],
)
def test_what_has_no_near_rotation_is_refused(rotation: Floats, said: str) -> None:
    with pytest.raises(BadTransformError, match=f"^pose 0 {said}"):
        poses.renormalise(pose_of(rotation))
