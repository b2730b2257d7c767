"""Test `solidcloud doctor`: what it reports, what it calls a fault, its advice and its exit code."""

import json
import os
import subprocess
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from solidcloud.server.cli.doctor import check_list, installation_checks, machine_checks, self_test_run
from solidcloud.server.cli.doctor.check import Check, Status
from solidcloud.server.cli.doctor.kernel_cache_check import check_kernel_cache
from solidcloud.server.cli.doctor.self_test import brute_force, compare
from solidcloud.server.cli.main import run

compiled = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="the child compiles")


def by_name(checks: Any) -> dict[str, Check]:
    return {check.name: check for check in checks}


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave the self-test out."""
    kept = tuple(check for check in check_list.CHECKS if check is not check_list.check_self_test)
    monkeypatch.setattr(check_list, "CHECKS", kept)


@compiled
def test_a_sound_machine_passes(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["doctor", "--json"]) == 0
    shown = capsys.readouterr()
    found = json.loads(shown.out)
    assert found["ok"] and shown.err == ""
    checks = {each["name"]: each for each in found["checks"]}
    assert checks["solidcloud"]["text"].startswith(metadata.version("solidcloud"))
    assert metadata.version("llvmlite") in checks["numba"]["text"] and "HDF5 " in checks["h5py"]["text"]
    assert "zstd " in checks["zstandard"]["text"]
    assert {"numpy", "eclipse-zenoh", "processor", "cores", "memory", "disk", "open files"} <= set(checks)
    assert "equal brute force" in checks["self-test"]["text"]
    assert not [each for each in found["checks"] if each["status"] == "fault"]


@pytest.mark.interpreted
def test_a_fault_says_what_to_do_and_is_the_exit_code(
    quick: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    assert run(["doctor"]) == 1
    shown = capsys.readouterr()
    lines = shown.out.splitlines()
    at = next(k for k, line in enumerate(lines) if line.startswith("fault"))
    assert "kernel cache" in lines[at] and str(tmp_path) in lines[at]
    assert lines[at + 1].strip().startswith("set NUMBA_CACHE_DIR to a folder that you alone may write")
    assert lines[-1].endswith("found a fault: kernel cache") and shown.err == ""


@pytest.mark.interpreted
def test_a_kernel_cache_that_others_may_write_is_a_fault(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    (tmp_path / "solidcloud-kernels").mkdir()
    (tmp_path / "solidcloud-kernels").chmod(0o777)
    (found,) = check_kernel_cache()
    assert found.status is Status.FAULT and "mode 777" in found.text and found.advice.startswith("set NUMBA")


@pytest.mark.interpreted
@pytest.mark.parametrize(("version", "status"), [(None, "fault"), ("0.70.0", "fault")])
def test_a_library_that_is_missing_or_new_is_a_fault(
    version: str | None, status: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = installation_checks._installed
    monkeypatch.setattr(
        installation_checks, "_installed", lambda name: version if name == "numba" else real(name)
    )
    found = by_name(installation_checks.check_libraries())
    assert found["numba"].status == status and found["numba"].advice.startswith("pip install 'numba")
    assert found["numpy"].status is Status.OK


@pytest.mark.interpreted
def test_an_extra_that_is_missing_is_a_note(monkeypatch: pytest.MonkeyPatch) -> None:
    real = installation_checks._installed
    monkeypatch.setattr(
        installation_checks, "_installed", lambda name: None if name == "pye57" else real(name)
    )
    found = by_name(installation_checks.check_extras())["extra readers"]
    assert found.status is Status.NOTE and "not installed: pye57" in found.text
    assert found.advice == "pip install 'solidcloud[readers]'"


@pytest.mark.interpreted
def test_the_limits_of_a_container_count(monkeypatch: pytest.MonkeyPatch) -> None:
    files = {
        "meminfo": "MemTotal: 64000000 kB\nMemAvailable: 50000000 kB\n",
        "memory.max": "1073741824\n",
        "memory.current": "536870912\n",
        "cpu.max": "50000 100000\n",
    }
    monkeypatch.setattr(machine_checks, "_read", lambda path: files.get(path.name, ""))
    (memory,) = machine_checks.check_memory()
    assert memory.status is Status.WARNING and memory.text.startswith("512.0 MB free of 1.0 GB")
    cores = by_name(machine_checks.check_cpu())["cores"]
    assert (
        cores.status is Status.NOTE
        and "limited to the time of 0.5" in cores.text
        and "--jobs 1" in cores.advice
    )


@pytest.mark.interpreted
def test_a_check_that_fails_is_a_fault_and_the_others_follow(monkeypatch: pytest.MonkeyPatch) -> None:
    def check_moon() -> Any:
        raise OSError("out of reach")
        yield

    monkeypatch.setattr(check_list, "CHECKS", (check_moon, machine_checks.check_cpu))
    first, *others = check_list.all_checks()
    assert first == Check("moon", Status.FAULT, "the check failed: OSError: out of reach") and others


def answer(**changes: Any) -> str:
    sound = {"first_seconds": 1.0, "seconds": 0.9, "points": 9, "poses": 5, "contacts": 2, "wrong": []}
    return json.dumps({**sound, **changes}) + "\n"


@pytest.mark.interpreted
@pytest.mark.parametrize(
    ("code", "out", "status", "said"),
    [
        (0, answer(), "ok", "9 points built and queried in 0.9 s"),
        (0, answer(wrong=["collide: 3 of 5 verdicts differ"]), "fault", "3 of 5 verdicts differ"),
        (0, answer(seconds=40.0), "warning", "in 40.0 s"),
        (-11, "", "fault", "ended with SIGSEGV"),
        (1, "", "fault", "ended with exit code 1: ImportError: no numba"),
    ],
)
def test_the_self_test_is_judged(
    code: int, out: str, status: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    done = subprocess.CompletedProcess([], code, out, "Traceback\nImportError: no numba\n")
    monkeypatch.setattr(self_test_run.subprocess, "run", lambda *_, **__: done)
    (found,) = self_test_run.check_self_test()
    assert found.status == status and said in found.text
    assert ("remove the compiled kernels" in found.advice) == (status == "fault")


@pytest.mark.interpreted
def test_wrong_answers_are_found() -> None:
    scan, avatar, poses = np.zeros((1, 3)), np.zeros((1, 3)), np.tile(np.eye(4), (3, 1, 1))
    poses[:, 0, 3] = 0.0, 1.0, 3.0
    expected = brute_force(scan, avatar, poses, 1.5)
    assert expected.tolist() == [-1.5, -0.5, 1.5]
    right = np.array([1, 1, 0], np.uint8)
    assert compare(right, expected, expected) == []
    assert compare(right[::-1], expected, expected) == ["collide: 2 of 3 verdicts differ from brute force"]
    assert len(compare(right, np.array([np.nan, -0.5, np.inf]), expected)) == 1
