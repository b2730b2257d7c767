"""Test builds on two dask workers: the bytes are those of one process, also when a worker is killed."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("distributed")

import solidcloud.builder.build_limits as build_limits
import solidcloud.builder.pipeline as pipeline_module
import solidcloud.builder.run.dask_cluster as cluster_module
import solidcloud.builder.run.executor as executor_module
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.builder.pipeline import build_archive
from solidcloud.server.cli.main import run

VOXEL = 0.5


@pytest.fixture(scope="module")
def scans(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write two scans of a floor and a wall, 20,000 points in about 90 voxels."""
    folder = tmp_path_factory.mktemp("scans")
    rng = np.random.default_rng(7)
    for name, axis in (("floor", 2), ("wall", 1)):
        points = rng.uniform(0, 3, (10_000, 3))
        points[:, axis] = rng.normal(1, 0.002, len(points))
        np.savetxt(folder / f"{name}.xyz", points, fmt="%.4f")
    return folder


@pytest.fixture(autouse=True)
def small_units(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the build write about 40 shards of a few voxels, so that it has a middle."""
    monkeypatch.setattr(build_limits, "SHARD_POINTS", 2000)


@pytest.fixture(scope="module")
def alone(scans: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, bytes]]:
    """Return the archive that a single process builds from the scans."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(build_limits, "SHARD_POINTS", 2000)
        target = tmp_path_factory.mktemp("alone") / "hall"
        build_archive([scans], target, BuildConfig(voxel=VOXEL, jobs=1))
        yield content(target)


def content(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


@pytest.fixture(scope="module")
def scheduler(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Return the address of a scheduler of another process, with two workers in another folder."""
    code = (
        "from distributed import LocalCluster; import sys\n"
        "if __name__ == '__main__':\n"
        "    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address='127.0.0.1:0') as cluster:\n"
        "        print(cluster.scheduler_address, flush=True); sys.stdin.read()\n"
    )
    folder = tmp_path_factory.mktemp("cluster")
    (folder / "there").mkdir()
    (folder / "cluster.py").write_text(code)
    process = subprocess.Popen(
        [sys.executable, "-P", folder / "cluster.py"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=folder / "there",
    )
    assert process.stdin and process.stdout
    try:
        yield process.stdout.readline().strip()
    finally:
        process.stdin.close()
        process.wait(30)


class Killer(threading.Thread):
    """Thread that kills one worker of the cluster as soon as the first shard exists."""

    def __init__(self, target: Path) -> None:
        super().__init__(daemon=True)
        self.work = target.parent / f".{target.name}.building"
        self.clusters: list[cluster_module.LocalCluster] = []
        self.killed, self.shards = 0, 0

    def run(self) -> None:
        """Wait for the shard and kill the worker."""
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            self.shards = len([*self.work.glob("**/0-*.h5")])
            if self.shards and self.clusters:
                self.killed = self.clusters[-1].workers[0].pid
                os.kill(self.killed, signal.SIGKILL)
                return
            time.sleep(0.001)


@pytest.mark.slow
def test_a_worker_killed_in_mid_build_changes_no_byte(
    scans: Path,
    alone: dict[str, bytes],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    target = tmp_path / "hall"
    killer = Killer(target)
    start = cluster_module._start_local

    def watched(number: int, memory: int, watch: cluster_module._Watch) -> cluster_module.LocalCluster:
        killer.clusters.append(start(number, memory, watch))
        return killer.clusters[-1]

    monkeypatch.setattr(cluster_module, "_start_local", watched)
    killer.start()
    summary = build_archive([scans], target, BuildConfig(voxel=VOXEL, cluster="local:2"))
    killer.join()

    assert killer.killed and 0 < killer.shards < summary.shards
    assert "died; its units are run again" in capsys.readouterr().err
    assert content(target) == alone
    assert not verify_archive(target).faults
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hall"]


@pytest.mark.slow
def test_no_more_workers_read_records_back_than_may_hold_them(
    scheduler: str, scans: Path, alone: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    handed_out: list[int] = []
    submit, radius = cluster_module.ClusterExecutor.submit, pipeline_module._measure_radius

    def watched(executor: cluster_module.ClusterExecutor, function: object, unit: object) -> object:
        handle = submit(executor, function, unit)
        handed_out.append(len(executor._given))
        return handle

    def from_here_on(*arguments: object) -> object:
        monkeypatch.setattr(cluster_module.ClusterExecutor, "submit", watched)
        return radius(*arguments)

    monkeypatch.setattr(pipeline_module, "_measure_radius", from_here_on)
    monkeypatch.setattr(pipeline_module, "readers_that_fit", lambda *_: 1)
    monkeypatch.setattr(executor_module, "_MIN_POINTS", 1)
    build_archive([scans], tmp_path / "hall", BuildConfig(voxel=VOXEL, scheduler=scheduler))
    assert len(handed_out) > 20 and set(handed_out) == {1}
    assert content(tmp_path / "hall") == alone


def test_a_scheduler_that_runs_elsewhere_makes_the_same_archive(
    scheduler: str, scans: Path, alone: dict[str, bytes], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Test workers that were started by hand in another folder than the builder's, with relative paths."""
    monkeypatch.chdir(scans)
    archive = os.path.relpath(tmp_path / "hall")
    config = BuildConfig(voxel=VOXEL, scheduler=scheduler)
    build_archive([Path(".")], Path(archive), config)
    # The index contains the paths of the scans as given; everything else is the same.
    found = content(tmp_path / "hall")
    assert found.keys() == alone.keys()
    assert {name for name in found if found[name] != alone[name]} <= {"index.h5"}


@pytest.mark.slow
def test_what_is_wrong_on_the_cluster_is_said_as_here(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bad.xyz").write_text("1 2 3\n4 5 six\n")
    said = {}
    for name, more in (("alone", ["--jobs", "1"]), ("cluster", ["--cluster", "local:2"])):
        code = run(["build", str(tmp_path / "bad.xyz"), "-o", str(tmp_path / "hall"), *more])
        lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
        said[name] = (code, lines)
    assert said["cluster"] == said["alone"]
    assert said["alone"][0] == 3 and len(said["alone"][1]) == 1
    assert [path.name for path in tmp_path.iterdir()] == ["bad.xyz"]


def test_a_scheduler_that_does_not_answer_is_said(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cluster_module, "REACH_SECONDS", 1)
    np.savetxt(tmp_path / "good.xyz", np.eye(3))
    more = ["--scheduler", "tcp://127.0.0.1:1"]
    assert run(["build", str(tmp_path / "good.xyz"), "-o", str(tmp_path / "hall"), *more]) == 2
    assert "tcp://127.0.0.1:1: no dask scheduler answers" in capsys.readouterr().err


def test_without_dask_it_is_said_what_to_install(tmp_path: Path) -> None:
    np.savetxt(tmp_path / "good.xyz", np.eye(3))
    words = ["build", str(tmp_path / "good.xyz"), "-o", str(tmp_path / "hall"), "--cluster", "local:2"]
    hidden = "import sys; sys.modules['distributed'] = None; from solidcloud.server.cli.main import run"
    code = f"{hidden}; sys.exit(run({words!r}))"
    done = subprocess.run([sys.executable, "-P", "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "'distributed' is not installed: pip install 'solidcloud[cluster]'" in done.stderr
    assert "Traceback" not in done.stderr
