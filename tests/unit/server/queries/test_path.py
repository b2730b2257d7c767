"""Parts of a path: all of it, in order, whoever computes them; without an engine."""

import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from solidcloud.schemas.errors import BadTransformError
from solidcloud.schemas.wire.answers import CollideAnswers, CollidePart
from solidcloud.server.queries import path as path_module
from solidcloud.server.queries.path import largest_part, path_parts


def answers(start, stop, seconds=0.0):
    """Answers that say which they are."""
    counts = np.arange(start, stop, dtype=np.uint32)
    verdict = (counts % 3).astype(np.uint8)
    return CollideAnswers(verdict, verdict > 1, counts, counts, counts, engine_seconds=seconds)


@pytest.fixture
def pool():
    with ThreadPoolExecutor(3) as pool:
        yield pool


@pytest.mark.parametrize("total", [0, 1, 63, 64, 65, 5000])
@pytest.mark.parametrize("ahead", [1, 2, 7])
def test_parts_are_all_of_it_in_order(pool, total, ahead):
    rng = np.random.default_rng(total)
    naps = rng.uniform(0, 0.002, 10_000)

    def ask(start, stop):
        time.sleep(naps[start])
        return answers(start, stop, naps[stop])

    for parts in (path_parts(ask, total), path_parts(ask, total, 100, pool, ahead)):
        found = list(parts)
        assert all(type(part) is CollidePart and part.total == total for part in found)
        assert [part.first for part in found] == [0, *np.cumsum([len(part) for part in found])[:-1].tolist()]
        assert np.concatenate([part.node_visits for part in found]).tolist() == list(range(total))
        assert len(found) == 1 or min(len(part) for part in found) > 0
        assert max(len(part) for part in found) <= path_module.LARGEST_PART


def test_no_more_than_asked_for_is_computed_ahead(pool):
    begun, lock = [], threading.Lock()

    def ask(start, stop):
        with lock:
            begun.append(start)
        return answers(start, stop)

    parts = path_parts(ask, 10**6, 10, pool, 4)
    for taken in range(1, 20):
        next(parts)
        assert len(begun) <= taken + 4
    parts.close()


def test_a_path_that_is_left_leaves_nothing_running(pool):
    gate = threading.Event()
    done = []

    def ask(start, stop):
        if start:
            assert gate.wait(20)
        done.append(start)
        return answers(start, stop)

    parts = path_parts(ask, 10**5, 10, pool, 8)
    next(parts)
    parts.close()
    gate.set()
    assert pool.submit(lambda: True).result(20)
    pool.shutdown()
    assert len(done) <= 4, "three at work when it was left, none after"


def test_an_error_comes_in_its_place_and_says_where(pool):
    def ask(start, stop):
        if start >= 64:
            raise BadTransformError("motion 3 turns")
        return answers(start, stop)

    for parts in (path_parts(ask, 1000), path_parts(ask, 1000, 200, pool, 4)):
        assert len(next(parts)) == 64
        with pytest.raises(BadTransformError, match="begins at 64: motion 3 turns"):
            next(parts)


def test_contacts_along_a_path_fit_a_message():
    assert largest_part("collide", {}) == path_module.LARGEST_PART
    assert largest_part("contacts", {}) * 184 * 100 <= 8 << 20
    assert largest_part("contacts", {"limit": 10_000}) == 4
    assert largest_part("contacts", {"limit": 0}) == path_module.LARGEST_PART
