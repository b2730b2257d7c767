"""Changes of what is resident: they follow the cache exactly, are bounded, and say what is missing."""

import threading

import archive_cases
import numpy as np
import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.wire.residency_messages import Residency, ResidencyChanges
from solidcloud.server.residency import voxel_cache
from solidcloud.server.scene import Scene

AVATAR = np.array([[0.0, 0.0, 0.0], [0.02, 0.0, 0.0]])


@pytest.fixture(scope="module")
def case(tmp_path_factory: pytest.TempPathFactory) -> archive_cases.Case:
    """Points in some hundred voxels."""
    places = np.random.default_rng(2).uniform(0, 2, (20_000, 3))
    return archive_cases.build(tmp_path_factory.mktemp("changes"), places, voxel=0.4)


def opened(case: archive_cases.Case, share: float = 0.25, policy: str = "lru") -> Scene:
    """Open a scene whose cache holds a share of it, with an avatar."""
    with Scene.open(case.archive) as whole, whole.archives[0].take() as generation:
        budget = int(generation.store.sizes.sum() * share)
    scene = Scene.open(case.archive, budget_bytes=budget, policy=policy)
    scene.add_avatar("al", AVATAR, 0.01)
    return scene


def resident(scene: Scene) -> set[tuple[int, ...]]:
    """Return the resident voxels, from the list of voxels."""
    listed = scene.voxels((0, 0, 0))
    return {tuple(voxel) for voxel in listed.voxel[listed.resident].tolist()}


def apply(known: set[tuple[int, ...]], message: ResidencyChanges) -> None:
    """Update what a reader knows to be resident."""
    for voxel, state in zip(message.voxel.tolist(), message.state.tolist(), strict=True):
        if state in (Residency.LOADED, Residency.PREFETCHED):
            known.add(tuple(voxel))
        else:
            known.discard(tuple(voxel))


def visit(scene: Scene, rng: np.random.Generator) -> None:
    """Ask about a random place."""
    pose = np.eye(4)
    pose[:3, 3] = rng.uniform(0, 2, 3)
    scene.collide("al", pose, margin=0.01)


def test_changes_follow_the_cache(case: archive_cases.Case) -> None:
    rng = np.random.default_rng(6)
    with opened(case) as scene:
        for _ in range(10):
            visit(scene, rng)
        with scene.residency_changes() as changes:
            first = changes.take()
            assert first is not None and first.lost and first.seq == 1
            known, seq, evicted = resident(scene), 1, 0
            for number in range(300):
                visit(scene, rng)
                if number % 7:
                    continue
                message = changes.take(always=True)
                assert message is not None and not message.lost
                assert message.seq == (seq := seq + 1)
                assert message.resident == scene.residency.resident
                assert message.resident_bytes == scene.residency.resident_bytes
                assert len(np.unique(message.voxel, axis=0)) == len(message.voxel)
                evicted += (message.state == Residency.EVICTED).sum()
                apply(known, message)
                assert known == resident(scene)
            assert evicted > 20
        scene.residency.check()
        assert not scene.residency.stats.logs, "nothing is collected without a reader"


def test_changes_beyond_the_limit_are_said_to_be_lost(
    case: archive_cases.Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(voxel_cache, "MAX_CHANGED_VOXELS", 2)
    rng = np.random.default_rng(3)
    with opened(case) as scene, scene.residency_changes() as changes:
        changes.take()
        for _ in range(40):
            visit(scene, rng)
        message = changes.take()
        assert message is not None and message.lost and len(message.voxel) == 2
        after = changes.take(always=True)
        assert after is not None and not after.lost


def test_a_reload_is_followed(case: archive_cases.Case) -> None:
    rng = np.random.default_rng(4)
    with opened(case) as scene, scene.residency_changes() as changes:
        changes.take()
        visit(scene, rng)
        scene.reload()
        message = changes.take()
        assert message is not None and message.lost
        known = resident(scene)
        for _ in range(30):
            visit(scene, rng)
        message = changes.take()
        assert message is not None and not message.lost
        apply(known, message)
        assert known == resident(scene)


def test_changes_end_with_the_scene_and_with_the_reader(case: archive_cases.Case) -> None:
    with opened(case) as scene:
        changes = scene.residency_changes()
        reader = threading.Thread(target=lambda: list(changes))
        reader.start()
        changes.close()
        reader.join(10.0)
        assert not reader.is_alive()
        changes = scene.residency_changes()
    assert list(changes) == []
    changes.close()
    with pytest.raises(BadRequestError, match="closed"):
        scene.residency_changes()
