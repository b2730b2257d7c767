"""Units on a cluster: the same results in the same order as in this process, and a word on what went wrong."""

import os
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import pytest

pytest.importorskip("distributed")

import solidcloud.builder.run.dask_cluster as cluster_module
from distributed import LocalCluster
from solidcloud.builder.run.dask_cluster import ClusterExecutor, local_workers
from solidcloud.builder.run.executor import WAITING, Silent
from solidcloud.builder.run.software_versions import software_versions
from solidcloud.schemas.errors import BadRequestError, ScanError, SolidcloudError

DIE = "__import__('os').kill(__import__('os').getpid(), 9)"
FAIL = "exec('from solidcloud.schemas.errors import ScanError; raise ScanError(\"hall.las: cut off\")')"


class Counted(Silent):
    """Progress that adds up."""

    done = 0

    def advance(self, amount: int) -> None:
        """Add."""
        self.done += amount


@pytest.fixture(scope="module")
def said() -> list[str]:
    return []


@pytest.fixture(scope="module")
def executor(said: list[str]) -> Iterator[ClusterExecutor]:
    with ClusterExecutor("local:2", 1 << 30, said.append) as found:
        yield found


def mapped(executor: ClusterExecutor, *units: str) -> list[object]:
    return list(executor.map(eval, units, Silent(), lambda _: 1))


def test_results_come_in_the_order_of_the_units(executor: ClusterExecutor, said: list[str]) -> None:
    progress = Counted()
    results = executor.map(partial(divmod, 100), range(1, 41), progress, lambda unit: unit)
    assert next(results) == (100, 0)
    assert progress.done >= 1  # advances when a unit is done
    assert list(results) == [divmod(100, i) for i in range(2, 41)]
    assert progress.done == sum(range(1, 41))
    assert executor.jobs == 2
    assert said[0].startswith("cluster: 2 workers; ") and "dashboard" in said[0]


def test_what_a_unit_raises_is_raised_here(executor: ClusterExecutor) -> None:
    with pytest.raises(ScanError, match=r"^hall\.las: cut off$") as raised:
        mapped(executor, "1", FAIL, *["__import__('time').sleep(0.2)"] * 6)
    assert raised.value.exit_code == 3
    assert not executor._given  # all that waited was taken back
    # A unit's own TimeoutError is not taken for that of waiting for it.
    with pytest.raises(TimeoutError, match="the disk"):
        mapped(executor, "exec('raise TimeoutError(\"the disk\")')")
    assert mapped(executor, "6 * 7") == [42]


def test_no_worker_waits_for_anothers_long_unit(executor: ClusterExecutor, tmp_path: Path) -> None:
    executor._client.wait_for_workers(2, 30)
    # The first unit ends when the last has begun: were units handed out in order of results, it never would.
    flag, units = str(tmp_path / "last"), 3 * WAITING * executor.jobs
    first = f"exec('import os, time\\nwhile not os.path.exists(\"{flag}\"): time.sleep(0.01)')"
    assert len(mapped(executor, first, *["1"] * units, f"open({flag!r}, 'w').close()")) == units + 2


def test_a_unit_whose_worker_is_killed_is_run_again(
    executor: ClusterExecutor, said: list[str], tmp_path: os.PathLike[str]
) -> None:
    flag = os.path.join(tmp_path, "tried")
    once = (
        f"{DIE} if not __import__('os').path.exists({flag!r}) and not open({flag!r}, 'w').close() else 'done'"
    )
    assert mapped(executor, "0", once, "2") == [0, "done", 2]
    assert any("died; its units are run again" in line for line in said)


def test_a_scheduler_is_used_where_it_is_and_left_running(
    executor: ClusterExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert executor._cluster is not None
    address, said = executor._cluster.scheduler_address, []
    with ClusterExecutor(address, say=said.append) as other:
        assert mapped(other, "1 + 1") == [2]
        assert other.jobs in (1, 2)  # a test before this one kills some, which are started anew
    assert "dashboard http" in said[0]
    assert mapped(executor, "1 + 1") == [2]

    monkeypatch.setattr(
        cluster_module, "software_versions", lambda: {**software_versions(), "zstandard": "0.1"}
    )
    with pytest.raises(
        BadRequestError, match=r"worker tcp://\S+: zstandard [\d.]+, expected 0\.1 as the builder has"
    ):
        ClusterExecutor(address)
    # One that joins later is looked at when it gets its first unit.
    with pytest.raises(SolidcloudError, match=r"zstandard [\d.]+, expected 0\.1") as caught:
        mapped(executor, "1")
    assert caught.type is SolidcloudError  # the request was a good one: what is done stays
    monkeypatch.setattr(cluster_module, "software_versions", software_versions)
    monkeypatch.setattr(os, "getcwd", lambda: "/nowhere/at/all")
    with pytest.raises(SolidcloudError, match=r"no folder /nowhere/at/all.*need the same files"):
        mapped(executor, "1")


def test_a_cluster_that_is_not_as_needed_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_module, "REACH_SECONDS", 1)
    with pytest.raises(BadRequestError, match=r"tcp://127\.0\.0\.1:1: no dask scheduler answers within 1 s"):
        ClusterExecutor("tcp://127.0.0.1:1")
    options = {
        "host": "127.0.0.1",
        "dashboard_address": "127.0.0.1:0",
        "processes": False,
        "protocol": "tcp://",
    }
    with LocalCluster(n_workers=0, threads_per_worker=1, **options) as empty:
        with pytest.raises(
            BadRequestError, match="no worker, expected at least one: start its workers as `dask"
        ):
            ClusterExecutor(empty.scheduler_address)
        empty.scale(1)
        empty.wait_for_workers(1, 30)
        with ClusterExecutor(empty.scheduler_address, say=lambda _: None) as executor:
            monkeypatch.setattr(cluster_module, "LOOK_SECONDS", 0.1)
            monkeypatch.setattr(cluster_module, "LONELY_SECONDS", 0.3)
            empty.scale(0)
            while executor._client.scheduler_info()["workers"]:
                time.sleep(0.05)
            with pytest.raises(SolidcloudError, match=r"no worker left for 0\.3 s: start some"):
                mapped(executor, "1")
    with (
        LocalCluster(n_workers=1, threads_per_worker=3, **options) as threads,
        pytest.raises(BadRequestError, match="3 threads, expected one"),
    ):
        ClusterExecutor(threads.scheduler_address)


@pytest.mark.parametrize(
    "address", ["local:", "local:0", "local:-1", "local:two", "host:8786", "tcp://", "foo://h:1", ""]
)
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(BadRequestError, match="expected"):
        local_workers(address)
