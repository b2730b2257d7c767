"""Test starts with damaged compiled kernels: right answers, exit code 0, and one warning."""

import json
import logging
import os
import pickle
import random
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import pytest
from solidcloud.schemas.runtime import compiling
from solidcloud.schemas.runtime.compiling import njit
from solidcloud.schemas.runtime.kernel_files import KernelFiles

pytestmark = pytest.mark.skipif(
    os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="interpreted kernels are not kept"
)

CODE = """
import json
import numpy as np
from solidcloud.schemas.kernels.morton import morton_code, morton_position
codes = [morton_code(*xyz) for xyz in np.array([[1, 2, 3], [7, 0, 5]], np.uint64)]
print(json.dumps({
    "codes": codes,
    "decoded": [morton_position(np.uint64(code)) for code in codes],
    "compiled": sum(sum(kernel.stats.cache_misses.values()) for kernel in (morton_code, morton_position)),
}))
"""
# Starts with each cache, twice each: children of one process that has imported numba, and nothing of solidcloud.
STARTS = f"""
import json, os, sys, tempfile, traceback
import numba, numpy
from numba.core import config
numba.njit(lambda a: a + 1)(1)

def start(cache):
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as error:
        child = os.fork()
        if child == 0:
            code = 1
            try:
                os.dup2(out.fileno(), 1)
                os.dup2(error.fileno(), 2)
                os.environ["NUMBA_CACHE_DIR"] = cache
                config.reload_config()
                exec({CODE!r}, {{"__name__": "__main__"}})
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                sys.stdout.flush()
                sys.stderr.flush()
                os._exit(code)
        code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
        out.seek(0)
        error.seek(0)
        return code, out.read().decode(), error.read().decode()

print(json.dumps({{cache: [start(cache), start(cache)] for cache in sys.argv[1:]}}))
"""
# Interleaved by hand: bits of x, y, z from the lowest.
ANSWER = {"codes": [53, 333], "decoded": [[1, 2, 3], [7, 0, 5]]}


def start(cache: Path, **environment: str) -> tuple[dict[str, object], list[str]]:
    """Run a process that needs two kernels; what it printed, and the lines of its standard error."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", CODE],
        env=os.environ | {"NUMBA_CACHE_DIR": str(cache)} | environment,
        capture_output=True,
        text=True,
        timeout=240,
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout), done.stderr.splitlines()


@pytest.fixture(scope="module")
def warm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cache in which both kernels are."""
    cache = tmp_path_factory.mktemp("warm")
    found, said = start(cache)
    assert found == ANSWER | {"compiled": 2}
    assert said == []
    return cache


@pytest.fixture
def cache(warm: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    shutil.copytree(warm, tmp_path / "cache")
    return tmp_path / "cache"


def kernels(cache: Path) -> list[Path]:
    """The files that a warm start reads."""
    folder = cache / "solidcloud-kernels"
    return sorted([*folder.glob("*.morton_code-*"), *folder.glob("*.morton_position-*")])


def test_a_warm_start_compiles_nothing_and_is_silent(cache: Path) -> None:
    assert start(cache) == (ANSWER | {"compiled": 0}, [])


def test_no_fact_of_the_machine_decides_which_kernel_is_used(cache: Path) -> None:
    elsewhere = {
        "HOME": str(cache),
        "CUDA_HOME": "/opt/cuda",
        "NUMBA_NUM_THREADS": "1",
        "NUMBA_COLOR_SCHEME": "blue",
    }
    assert start(cache, **elsewhere) == (ANSWER | {"compiled": 0}, [])
    assert start(cache, NUMBA_OPT="2")[0] == ANSWER | {"compiled": 2}


def flip(paths: list[Path]) -> None:
    random.seed(2012)
    for path in paths:
        content = bytearray(path.read_bytes())
        content[random.randrange(len(content))] ^= 1 << random.randrange(8)
        path.write_bytes(content)


def swap(paths: list[Path]) -> None:
    one, other = (path.read_bytes() for path in paths)
    paths[0].write_bytes(other)
    paths[1].write_bytes(one)


def replace_by_folder(paths: list[Path]) -> None:
    for path in paths:
        path.unlink()
        (path / "inside").mkdir(parents=True)


def rewrite(paths: list[Path], payload: bytes) -> None:
    """Payloads that are nothing of numba's, with digests that are right: written damaged."""
    for path in paths:
        KernelFiles(path.parent).write(path.name, payload)


DAMAGES: dict[str, Callable[[list[Path]], object]] = {
    "flipped": flip,
    "other name": lambda paths: shutil.copy(paths[0], paths[1]),
    "wrong pickle": lambda paths: rewrite(paths, pickle.dumps(([1, 2], 3))),
}


@pytest.fixture(scope="module")
def damaged(warm: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[tuple[int, str, str]]]:
    """Exit code, output and errors of two starts with each damaged copy of the cache, by the copy's path."""
    caches = [tmp_path_factory.mktemp("damaged") / damage.replace(" ", "-") for damage in DAMAGES]
    for cache, damage in zip(caches, DAMAGES.values(), strict=True):
        shutil.copytree(warm, cache)
        paths = kernels(cache)
        assert len(paths) == 2
        damage(paths)
    done = subprocess.run(
        [sys.executable, "-P", "-c", STARTS, *map(str, caches)], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    found: dict[str, list[tuple[int, str, str]]] = json.loads(done.stdout)
    return found


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_kernel_is_compiled_again(
    damaged: dict[str, list[tuple[int, str, str]]], damage: str
) -> None:
    (cache,) = (cache for cache in damaged if Path(cache).name == damage.replace(" ", "-"))
    (code, out, said), again = damaged[cache]
    assert code == 0, said
    assert json.loads(out) == ANSWER | {"compiled": 1 if damage == "other name" else 2}
    assert len(said.splitlines()) == 1 and "is damaged" in said and cache in said
    assert (again[0], json.loads(again[1]), again[2]) == (0, ANSWER | {"compiled": 0}, "")


def test_a_long_compilation_is_reported_once(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    store, times = compiling._KernelStore(), iter([100.0, 100.5, 101.5, 120.0])
    monkeypatch.setattr(compiling, "time", SimpleNamespace(monotonic=lambda: next(times)))
    with caplog.at_level(logging.INFO, compiling.__name__):
        for reported in (0, 0, 1, 1):
            store._begin()
            assert len(caplog.messages) == reported


def test_a_kernel_with_variables_of_its_surroundings_is_refused() -> None:
    """Their values would decide the machine code, and are in no source."""
    value = 3
    with pytest.raises(TypeError, match="enclosing function"):

        @njit(cache=True)
        def kernel() -> int:
            return value
