"""Test a query that the product does not have, from declaration and engine to every way to call it."""

import json
from collections.abc import Iterator
from pathlib import Path

import naive
import naive_rays
import numpy as np
import pytest
from corner import client_of, served
from count_within_engine import count_within
from count_within_question import COUNT_WITHIN, CountWithinAnswers
from numpy.typing import NDArray
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.wire import key_expressions
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.question_table import QUESTIONS
from solidcloud.server import client as client_module
from solidcloud.server.cli.main import run
from solidcloud.server.queries.engine_table import ENGINES
from solidcloud.server.scene import Scene
from split_scans import STEP, Built, exact_pose, several

REACH = 0.3
Floats = NDArray[np.float64]


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Built:
    return Built(tmp_path_factory.mktemp("added"))


@pytest.fixture(autouse=True)
def added(monkeypatch: pytest.MonkeyPatch) -> None:
    """Declare the query and register its engine."""
    monkeypatch.setitem(QUESTIONS, COUNT_WITHIN.name, COUNT_WITHIN)
    monkeypatch.setitem(ENGINES, COUNT_WITHIN.name, count_within)


@pytest.fixture
def scene(built: Built) -> Iterator[Scene]:
    with Scene.open(built.whole, "hall") as scene:
        yield scene


def places(built: Built) -> Floats:
    """Return points near scan points, and one without scan points around it."""
    rng = np.random.default_rng(5)
    points = np.vstack(built.points)
    near = rng.choice(points, 40) + rng.normal(0, 0.2, (40, 3))
    return np.vstack([near, [[50.0, 50.0, 50.0]]])


def judged(scan: Floats, points: Floats) -> list[int]:
    """Return the number of scan points within reach of each point, by testing every pair."""
    stored = naive.scan_units(naive.lattice_of(scan, [0.0, 0, 0], STEP), STEP)
    apart = stored[None] - naive_rays.world_units(points, [0.0, 0, 0])[:, None]
    square = (apart.astype(object) ** 2).sum(axis=2)
    counts: list[int] = (square <= int(np.rint(REACH * naive.UNITS)) ** 2).sum(axis=1).tolist()
    return counts


def test_it_counts_as_brute_force_does(scene: Scene, built: Built) -> None:
    points = places(built)
    found = scene.ask(COUNT_WITHIN, points, REACH)
    expected = judged(np.vstack(built.points), points)
    assert isinstance(found, CountWithinAnswers) and len(set(expected)) > 5
    assert found.count.tolist() == expected
    assert found.exact.all() and not found.voxels_missing.any()
    assert found.verdict.tolist() == [int(Verdict.CONTACT if count else Verdict.CLEAR) for count in expected]
    assert scene.stats().answers == len(points)
    with pytest.raises(BadRequestError, match="reach"):
        scene.ask(COUNT_WITHIN, points, -1.0)


def test_a_deadline_leaves_no_point_clear_that_is_not(scene: Scene, built: Built) -> None:
    found = scene.ask(COUNT_WITHIN, points=places(built), reach=REACH, budget_ms=0)
    counts = np.array(judged(np.vstack(built.points), places(built)))
    assert (found.verdict[counts > 0] == Verdict.UNKNOWN).all() and not found.exact[counts > 0].any()


def test_it_is_asked_over_zenoh(scene: Scene, built: Built, monkeypatch: pytest.MonkeyPatch) -> None:
    points = places(built)
    expected = judged(np.vstack(built.points), points)
    with served(scene) as endpoint, client_of(endpoint) as client:
        assert client.ask(COUNT_WITHIN, points, REACH).count.tolist() == expected
        monkeypatch.setattr(client_module, "BATCH_POSES", 7)
        found = client.ask(COUNT_WITHIN, points, reach=REACH)
        assert found.count.tolist() == expected and len(found.verdict) == len(points)
        with pytest.raises(BadRequestError, match="reach is -1"):
            client.ask(COUNT_WITHIN, points, -1.0)


def test_what_nobody_answers_is_unknown(scene: Scene, built: Built, monkeypatch: pytest.MonkeyPatch) -> None:
    points = places(built)
    with served(scene) as endpoint, client_of(endpoint) as client:
        monkeypatch.setattr(client._connection, "ask_about", lambda *_: None)
        found = client.ask(COUNT_WITHIN, points, REACH)
    assert set(found.verdict.tolist()) == {Verdict.UNKNOWN}
    assert not found.count.any() and not found.exact.any()
    assert client.unanswered == len(points)


def test_counts_of_two_archives_add_up(built: Built) -> None:
    points = places(built)
    pose = exact_pose(np.random.default_rng(8))
    for other, scan in (
        (np.eye(4), built.points[1]),
        (pose, built.points[1] @ pose[:3, :3].T + pose[:3, 3]),
    ):
        with several((built.first, None), (built.second, other)) as both:
            found = both.ask(COUNT_WITHIN, points, REACH)
            assert found.count.tolist() == judged(np.vstack([built.points[0], scan]), points)
            assert found.exact.all()


def test_it_is_asked_by_the_command(
    scene: Scene, built: Built, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    points = places(built)
    file = tmp_path / "points.xyz"
    np.savetxt(file, points, fmt="%.17g")
    with served(scene) as endpoint:
        asked = ["query", "--scene", "hall", "--op", "count_within", "--connect", endpoint]
        assert run([*asked, "--points", str(file), "--reach", str(REACH), "--json"]) == 0
        told = json.loads(capsys.readouterr().out)
        assert run([*asked, "--points", str(file), "--reach", str(REACH)]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert run([*asked, "--points", str(file)]) == 2
        assert "--op count_within needs --reach: it takes --points, --reach" in capsys.readouterr().err
    expected = judged(np.vstack(built.points), points)
    assert [row["count"] for row in told["answers"]] == expected
    assert lines[0] == f"point 0  contact count {expected[0]}, exact True"
    assert lines[-1].startswith(f"{len(points)} points: ")


def test_without_its_declaration_it_is_no_operation(monkeypatch: pytest.MonkeyPatch) -> None:
    assert key_expressions.query_key("hall", "c", "count_within")
    monkeypatch.delitem(QUESTIONS, "count_within")
    with pytest.raises(BadRequestError, match="operation 'count_within': expected one of info, "):
        key_expressions.query_key("hall", "c", "count_within")
