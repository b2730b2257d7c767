"""Test scripts/fuzz_readers with some hundred mutants, and that it finds each kind of fault."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from broken_scans import SEEDS, mutate, with_checksums, write_seeds

SCRIPT = Path(__file__).parents[3] / "scripts" / "fuzz_readers"


def test_damaged_scans_are_read_or_refused_by_name() -> None:
    """Test a share of the 10,000 cases of scripts/fuzz_readers."""
    command = [sys.executable, str(SCRIPT), "--mutants", "198", "--seed", "5", "--jobs", "1"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    found = json.loads(done.stdout)
    assert found["faults"] == [] and done.returncode == 0
    assert found["mutants"] == 198 and set(found["by_seed"]) == set(SEEDS)
    # The damage is neither always found by the first check nor too slight to be noticed.
    assert found["outcomes"]["read"] > 20 and found["outcomes"]["refused"] > 60


# Outcome to be found -> code that runs instead of reading a scan.
FAULTS = {
    "crash by signal 9": "os.kill(os.getpid(), signal.SIGKILL)",
    "crash by exit 7": "os._exit(7)",
    "over 1 s": "sum(iter(int, 1))",
    "over 7 s": "time.sleep(60)",
    "another error": "{}[path]",
    "over 20 MB": "np.ones(30 << 20, np.uint8)",
    "an error that does not say where or what was expected": "raise ScanError('no')",
    "Unable to allocate": "np.zeros(1 << 30, np.uint8)",
}


@pytest.fixture(scope="module")
def readings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, Any]]:
    """Return what the script finds, by outcome, of a scan whose reading runs the code of FAULTS.

    Runs in a separate process with only the script: the memory of its forks is measured.
    """
    path = tmp_path_factory.mktemp("scan") / "a.las"
    path.write_bytes(b"no scan")
    program = f"""
import importlib.machinery, importlib.util, json, os, resource, signal, sys, time
from pathlib import Path
import numpy as np
from solidcloud.schemas.errors import ScanError
loader = importlib.machinery.SourceFileLoader("fuzz_readers", {str(SCRIPT)!r})
fuzz = importlib.util.module_from_spec(importlib.util.spec_from_loader("fuzz_readers", loader))
loader.exec_module(fuzz)
path = Path({str(path)!r})
first = fuzz.read_mutant(3, "a.las", path, 1 << 40)
pages = [int(count) * resource.getpagesize() for count in Path("/proc/self/statm").read_text().split()]
most_bytes, found = fuzz.MAX_BYTES, {{}}
for outcome, fault in {FAULTS!r}.items():
    room = pages[0] + (100 << 20) if outcome == "Unable to allocate" else 1 << 40
    fuzz.MAX_SECONDS = 1 if outcome == "over 1 s" else 7
    fuzz.LONGEST_WAIT = 0.5 if outcome == "over 7 s" else 60.0
    fuzz.MAX_BYTES = 20 << 20 if outcome.endswith("MB") else most_bytes
    code = compile(fault, "fault", "exec")
    fuzz.read_all = lambda path: exec(code, globals() | {{"path": path}})
    found[outcome] = fuzz.read_mutant(3, "a.las", path, room)._asdict()
print(json.dumps([first._asdict(), found]))
"""
    done = subprocess.run([sys.executable, "-P", "-c", program], capture_output=True, text=True, check=True)
    first, found = json.loads(done.stdout)
    assert first["outcome"] == "refused" and {each["number"] for each in found.values()} == {3}
    return found


@pytest.mark.parametrize("outcome", FAULTS)
def test_each_kind_of_fault_is_found(outcome: str, readings: dict[str, dict[str, Any]]) -> None:
    found = readings[outcome]
    if outcome == "Unable to allocate":
        assert found["outcome"] == "another error" and outcome in found["message"]
    else:
        assert found["outcome"] == outcome


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
