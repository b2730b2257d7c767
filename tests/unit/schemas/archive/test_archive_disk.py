"""Test full disks: the system's own error, naming the file, is raised whatever HDF5 makes of it."""

import errno
import resource
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from solidcloud.schemas.runtime.new_hdf5_file import new_hdf5_file


def write(path: Path, datasets: int = 40) -> None:
    """A file of many small datasets in groups, as shards are."""
    with new_hdf5_file(path) as file:
        file.attrs["format"] = np.bytes_("solidcloud shard")
        for i in range(datasets):
            group = file.create_group(f"{i:016x}", track_times=False)
            group.create_dataset("points", data=np.arange(50 * i), track_times=False)


@contextmanager
def largest_file(size: int) -> Iterator[None]:
    """No file of this process may become larger [bytes]; Python ignores the signal that comes with it."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_write_that_fails_is_the_systems_error_and_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = tmp_path / "whole.h5"
    write(whole)
    size = whole.stat().st_size
    # Where the limit lies decides what HDF5 is about to write: a header, a dataset, a group let go, the file closed.
    for limit in [0, 1, 40, 47, 48, 100, 500, *np.linspace(600, size - 1, 60).astype(int).tolist()]:
        with (
            pytest.raises(OSError, match=r"File too large: '.*part\.h5\..*\.tmp'") as raised,
            largest_file(limit),
        ):
            write(tmp_path / "part.h5")
        assert raised.value.errno == errno.EFBIG, limit
        assert sorted(path.name for path in tmp_path.iterdir()) == ["whole.h5"]
    captured = capsys.readouterr()
    assert captured.err == ""  # no traceback of an exception that is ignored
    with largest_file(size):
        write(tmp_path / "part.h5")
    assert (tmp_path / "part.h5").read_bytes() == whole.read_bytes()
