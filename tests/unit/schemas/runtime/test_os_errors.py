"""Test that errors of the operating system are reported in words, with the path concerned."""

import errno
import os
from pathlib import Path

import pytest
from solidcloud.schemas.errors import SolidcloudError
from solidcloud.schemas.runtime.os_errors import check_writable, naming_write_errors, os_error_line


def test_the_line_names_the_path_and_no_number():
    for number in (errno.EACCES, errno.ENOSPC, errno.EIO, errno.EMFILE, errno.ENOTDIR, errno.EROFS):
        line = os_error_line(OSError(number, os.strerror(number), "scans/hall.laz"))
        assert line.startswith("scans/hall.laz: ") and ": " in line[16:] and "Errno" not in line
    assert os_error_line(OSError(errno.EPIPE, "Broken pipe")) == "Broken pipe: check the path and the disk"
    assert os_error_line(OSError("Unable to open file")) == "Unable to open file"
    assert os_error_line(OSError(errno.EXDEV, "Invalid link", "a", None, "b")).startswith("b: ")


def test_writing_names_the_output_and_not_its_temporary_file(tmp_path: Path) -> None:
    output = tmp_path / "out.laz"
    with (
        pytest.raises(SolidcloudError, match=r"out\.laz: cannot be written: permission denied: .*choose"),
        naming_write_errors(output),
    ):
        raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / ".out.laz.71.tmp"))
    with (
        pytest.raises(
            SolidcloudError, match=r"out\.laz: cannot be written: no space left on the disk: make room"
        ),
        naming_write_errors(output),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")
    with (
        pytest.raises(SolidcloudError, match=r"there is no folder .*/no: make it first"),
        naming_write_errors(tmp_path / "no" / "out"),
    ):
        (tmp_path / "no" / "out").write_text("")


def test_an_error_about_another_file_stays_what_it_is(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), naming_write_errors(tmp_path / "out.laz"):
        (tmp_path / "in.laz").read_bytes()
    with pytest.raises(BrokenPipeError), naming_write_errors(tmp_path / "out.laz"):
        raise BrokenPipeError(errno.EPIPE, "Broken pipe")


def test_a_folder_is_probed_without_a_trace(tmp_path: Path) -> None:
    check_writable(tmp_path)
    assert not list(tmp_path.iterdir())
    with pytest.raises(OSError):
        check_writable(Path("/proc"))
