"""scripts/fuzz_readers: some hundred mutants now, and each kind of fault is found where there is one."""

import importlib.machinery
import importlib.util
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from broken_scans import SEEDS, mutate, with_checksums, write_seeds
from solidcloud.schemas.errors import ScanError

SCRIPT = Path(__file__).parents[3] / "scripts" / "fuzz_readers"


@pytest.fixture(scope="module")
def fuzz() -> ModuleType:
    """The script as a module."""
    loader = importlib.machinery.SourceFileLoader("fuzz_readers", str(SCRIPT))
    spec = importlib.util.spec_from_loader("fuzz_readers", loader)
    assert spec
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


def test_damaged_scans_are_read_or_refused_by_name() -> None:
    """A share of the 10,000 of scripts/fuzz_readers, which is where to look for more."""
    command = [sys.executable, str(SCRIPT), "--mutants", "308", "--seed", "5", "--jobs", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = json.loads(done.stdout)
    assert found["faults"] == [] and done.returncode == 0
    assert found["mutants"] == 308 and set(found["by_seed"]) == set(SEEDS)
    # Neither is all of it stopped at the first check, nor is the damage too slight to be seen.
    assert found["outcomes"]["read"] > 30 and found["outcomes"]["refused"] > 100


FAULTS = {
    "crash by signal 9": lambda path: os.kill(os.getpid(), signal.SIGKILL),
    "crash by exit 7": lambda path: os._exit(7),
    "over 1 s": lambda path: sum(iter(int, 1)),
    "over 7 s": lambda path: time.sleep(60),
    "another error": lambda path: {}[path],
    "over 20 MB": lambda path: np.ones(30 << 20, np.uint8),
    "an error that does not say where or what was expected": lambda path: (_ for _ in ()).throw(
        ScanError("no")
    ),
}


@pytest.mark.parametrize("outcome", FAULTS)
def test_each_kind_of_fault_is_found(
    outcome: str, fuzz: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.las"
    path.write_bytes(b"no scan")
    room = 1 << 40
    assert fuzz.read_mutant(3, "a.las", path, room).outcome == "refused"
    monkeypatch.setattr(fuzz, "MOST_SECONDS", 1 if outcome == "over 1 s" else 7)
    monkeypatch.setattr(fuzz, "LONGEST_WAIT", 0.5 if outcome == "over 7 s" else 60.0)
    if outcome.endswith("MB"):
        monkeypatch.setattr(fuzz, "MOST_BYTES", 20 << 20)
    monkeypatch.setattr(fuzz, "read_all", FAULTS[outcome])
    found = fuzz.read_mutant(3, "a.las", path, room)
    assert found.outcome == outcome and found.number == 3


def test_memory_beyond_the_bound_is_not_given(
    fuzz: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.las"
    path.write_bytes(b"no scan")
    monkeypatch.setattr(fuzz, "read_all", lambda path: np.zeros(1 << 30, np.uint8))
    room = int(Path("/proc/self/statm").read_text().split()[0]) * os.sysconf("SC_PAGE_SIZE") + (100 << 20)
    found = fuzz.read_mutant(0, "a.las", path, room)
    assert found.outcome == "another error" and "Unable to allocate" in found.message


def test_mutants_are_made_again_by_their_number_and_differ(tmp_path: Path) -> None:
    seeds = write_seeds(tmp_path)
    for name, data in seeds.items():
        made = [mutate(name, data, np.random.default_rng([9, k])) for k in range(20)]
        assert made == [mutate(name, data, np.random.default_rng([9, k])) for k in range(20)]
        assert len(set(made)) > 15 and all(made)


def test_checksums_are_those_that_the_format_has(tmp_path: Path) -> None:
    seeds = write_seeds(tmp_path)
    data = bytearray(seeds["two.e57"])
    assert with_checksums(bytes(data)) == data
    data[2000] ^= 1
    mended = with_checksums(bytes(data))
    assert [k // 1024 for k in range(len(data)) if mended[k] != data[k]] == [1] * 4
