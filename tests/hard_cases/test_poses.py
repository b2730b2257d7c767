"""Hard cases of origins and poses as they arrive; a test's number is its row in NUMERICS.md."""

from pathlib import Path

import archive_cases
import h5py
import numpy as np
import pytest
import synthetic_scans
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.archive.index import INDEX_NAME
from solidcloud.schemas.errors import BadRequestError, BadTransformError
from solidcloud.schemas.wire.encoding import JSON, MSGPACK, decode_answer, encode
from solidcloud.schemas.wire.scene_messages import SceneInfo
from solidcloud.server.cli.input.pose_file import read_poses
from solidcloud.server.scene import Scene

POINT = np.zeros((1, 3))
COLUMNS = "t,x,y,z,qw,qx,qy,qz\n"


@pytest.mark.case(
    2, "origin, step and radius: the same 64 bits in the index, in Python and on the wire, both encodings"
)
@pytest.mark.parametrize(
    "place", [(0.1 + 0.2, -1e-9 / 3, 1e9 / 3), (512345.678901234, 5612345.1, -0.3), (-1 / 3,) * 3]
)
def test_case_02_an_origin_comes_back_to_the_bit(tmp_path: Path, place: tuple[float, float, float]) -> None:
    lowest = np.array(place)
    points = np.concatenate([lowest[None], lowest + np.abs(synthetic_scans.make_scan("noise", 2, 20))])
    case = archive_cases.build(tmp_path, points, resolution=0.1 / 3, radius=0.1 / 7)
    expected = lowest.tobytes()
    with Archive(case.archive) as archive:
        header = archive.header
        assert np.array(header.lattice.origin).tobytes() == expected
        assert (header.lattice.step, header.radius) == (0.1 / 3, 0.1 / 7)
    with h5py.File(case.archive / INDEX_NAME) as file:
        kept = [d[()] for d in file.values() if isinstance(d, h5py.Dataset) and d.dtype == np.dtype("<f8")]
    # As numbers, wherever in the index they stand: printed to six digits a map moves by metres.
    assert any(expected in column.tobytes() for column in kept)
    with Scene.open(case.archive) as scene:
        info = scene.info()
    for encoding in (MSGPACK, JSON):
        received = decode_answer(SceneInfo, encode(info, encoding), encoding)
        assert np.array(received.origin).tobytes() == expected
        assert (received.lattice_step, received.radius) == (0.1 / 3, 0.1 / 7)


@pytest.mark.case(
    4,
    "a quaternion off by 1e-6 is normalised to rounding; 1 % off, zero or not finite, it is refused with its line",
)
def test_case_04_quaternions_are_normalised_or_refused(tmp_path: Path, rng: np.random.Generator) -> None:
    def rows(quaternions: np.ndarray) -> np.ndarray:
        """The poses read of a file of these, at 10 m from the origin."""
        text = "".join(f"0,10,0,0,{','.join(map(repr, q))}\n" for q in quaternions.tolist())
        (tmp_path / "poses.csv").write_text(COLUMNS + text)
        return read_poses(tmp_path / "poses.csv")[1]

    q = rng.normal(size=(50, 4))
    q /= np.linalg.norm(q, axis=1)[:, None]
    poses = rows(q)
    for off in (1 - 0.99e-6, 1 + 0.99e-6):
        apart = np.abs(rows(q * off) - poses).max()
        assert apart < 4e-16 * 4, apart
    products = np.einsum("kij,klj->kil", poses[:, :3, :3], poses[:, :3, :3])
    assert np.abs(products - np.eye(3)).max() < 2e-15
    for bad in (q[0] * 1.01, q[0] * (1 + 1.1e-6), q[0] * 0.0, q[0] * np.nan, np.full(4, np.inf)):
        with pytest.raises(BadRequestError, match=r"poses\.csv, line 4: "):
            rows(np.array([q[1], q[2], bad]))
    # What would come of it: a matrix that stretches, which the engine refuses too.
    w, x, y, z = q[0] * 1.01
    stretched = np.eye(4)
    stretched[:3, :3] = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    case = archive_cases.build(tmp_path, POINT, radius=0.5)
    with pytest.raises(BadTransformError):
        archive_cases.ask(case, POINT, 0.5, stretched[None])


@pytest.mark.case(
    5,
    "a pose rotated 10^6 times, queried each time: closes within 1 µm at 10 m, same verdict",
)
def test_case_05_a_pose_updated_a_million_times_closes(tmp_path: Path) -> None:
    count, chunk = 1_000_000, 100_000
    # Turned about z by a millionth of a full turn at a time and renormalised; a body point 10 m out.
    step = np.exp(2j * np.pi / count).item()
    case = archive_cases.build(
        tmp_path, np.array([[10.0, 0, 0], [0, 10.0, 0], [-10.0, 0.05, 0]]), radius=0.01
    )
    turn, verdicts, last = 1.0 + 0.0j, [], np.eye(4)
    with Scene.open(case.archive) as scene:
        scene.add_avatar("body", np.array([[10.0, 0, 0.02]]), 0.01 - 1e-6)
        for _ in range(0, count, chunk):
            turns = np.empty(chunk, complex)
            for i in range(chunk):
                turns[i] = turn = turn * step / abs(turn)
            poses = np.broadcast_to(np.eye(4), (chunk, 4, 4)).copy()
            poses[:, 0, 0] = poses[:, 1, 1] = turns.real
            poses[:, 1, 0], poses[:, 0, 1] = turns.imag, -turns.imag
            verdicts.append(scene.collide("body", poses, 1e-6).verdict)
            some = slice(None, None, chunk // 50)
            assert verdicts[-1][some].tolist() == case.judge(
                np.array([[10.0, 0, 0.02]]), 0.01 - 1e-6, poses[some], 1e-6
            ).astype(int).tolist()  # fmt: skip
            last = poses[-1]
        first = scene.collide("body", np.eye(4)[None], 1e-6).verdict[0]
        fresh = scene.collide("body", last[None], 1e-6).verdict[0]
    drift = np.linalg.norm(last @ [10.0, 0, 0.02, 1] - [10.0, 0, 0.02, 1])
    assert drift < 1e-6
    # Poses arrive whole and nothing adds up between them: the last of them is answered as a single pose is.
    assert verdicts[-1][-1] == fresh
    # Tangent within 15 nm at both ends: 1e-6 m of drift would show.
    assert first == 1 and 1 <= np.concatenate(verdicts).sum() < count / 10
