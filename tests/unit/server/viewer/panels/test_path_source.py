"""Test paths that a page sends in parts."""

import pytest
from solidcloud.schemas.errors import BadRequestError, TooLargeError
from solidcloud.server.viewer.page.page_messages import PathText
from solidcloud.server.viewer.panels import path_source
from solidcloud.server.viewer.panels.path_source import PathParts

TEXT = "t,x,y,z,qw,qx,qy,qz\n0.5,1,2,3,1,0,0,0\n1.5,4,5,6,1,0,0,0\n"


def test_path_is_that_of_its_parts() -> None:
    parts = PathParts()
    # A file that was not sent completely is forgotten.
    assert parts.take(PathText("a.csv", "rubbish", True, False)) is None
    for start in range(0, len(TEXT), 10):
        path = parts.take(
            PathText("b.csv", TEXT[start : start + 10], first=start == 0, last=start + 10 >= len(TEXT))
        )
    assert path is not None
    assert (path.name, path.times.tolist()) == ("b.csv", [0.5, 1.5])
    assert path.poses[:, :3, 3].tolist() == [[1, 2, 3], [4, 5, 6]]


def test_text_may_begin_with_a_byte_order_mark() -> None:
    path = PathParts().take(PathText("a.csv", "\ufeff" + TEXT, first=True, last=True))
    assert path is not None


def test_invalid_and_large_files_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    parts = PathParts()
    with pytest.raises(BadRequestError, match=r"a\.csv, line 4: 1 values: expected 8"):
        parts.take(PathText("a.csv", TEXT + "7\n", first=True, last=True))
    monkeypatch.setattr(path_source, "MAX_PATH_TEXT", 100)
    assert parts.take(PathText("a.csv", TEXT, first=True, last=False)) is None
    with pytest.raises(TooLargeError, match=r"a\.csv: 112 characters: at most 100"):
        parts.take(PathText("a.csv", TEXT, first=False, last=True))
    assert parts.take(PathText("a.csv", TEXT, first=True, last=True)) is not None
