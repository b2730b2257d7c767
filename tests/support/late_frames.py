"""Scenes whose loads can be blocked, and a judge of the paths of frames, for frames that do not wait."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.scene import Scene

Floats = NDArray[np.float64]

# Longest wait for what takes milliseconds when it is right [s].
PATIENCE = 60.0


@contextmanager
def blocked_loads(scene: Scene) -> Iterator[threading.Event]:
    """Block all loads of voxels of a scene, and of its levels of detail, until the event is set."""
    gate, stores = threading.Event(), []
    with scene.archives[0].take() as opened:
        stores = [opened.store] + ([] if opened.level is None else [opened.level.store])
    loads = [store.load for store in stores]

    def slow(load: Any) -> Any:
        def blocked(*what: Any) -> Any:
            assert gate.wait(PATIENCE)
            return load(*what)

        return blocked

    for store, load in zip(stores, loads, strict=True):
        store.load = slow(load)  # type: ignore[method-assign]
    try:
        yield gate
    finally:
        gate.set()
        for store, load in zip(stores, loads, strict=True):
            store.load = load  # type: ignore[method-assign]


def assert_crosses_nothing(judge: Scene, name: str, path: list[Floats]) -> None:
    """Assert that no pose of a path touches the scene, and that no motion between two of them does.

    judge: the scene with all its voxels in memory.  path: poses (4, 4), the first one clear.
    """
    poses = np.array(path)
    assert (judge.collide(name, poses).verdict == Verdict.CLEAR).all()
    if len(poses) > 1:
        assert (judge.sweep(name, poses[:-1], poses[1:]).verdict != Verdict.CONTACT).all()
