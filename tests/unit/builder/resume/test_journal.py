"""Notes are written whole or not at all, and what is noted is not done again."""

from pathlib import Path
from typing import Any

import pytest
import solidcloud.builder.resume.journal as journal_module
from solidcloud.builder.resume.journal import Journal, Work, new_file, remove_temporaries, resumed
from solidcloud.builder.run.executor import ProcessExecutor
from solidcloud.builder.run.progress import Silent


def test_a_file_is_forgotten_by_its_name(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    journal.note("spool/1", {"runs": {"a.run": [1, 2], "b.run": [3, 4]}})
    journal.note("done/1", {"name": "0-1.h5"})
    journal.note("done/2", {"name": "0-2.h5"})
    journal.note("survey/1", ["a.run"])
    journal.forget_file(tmp_path / "spool" / "b.run")
    journal.forget_file(tmp_path / "archive" / "0-2.h5")
    left = ["spool/1", "done/1", "done/2", "survey/1"]
    assert [name for name in left if journal.recall(name)] == ["done/1", "survey/1"]


def test_a_note_is_recalled_as_it_was(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    what = {"low": [float("inf"), 0.1, -1e300], "text": "Größe", "nested": {"a": [1, None]}}
    journal.note("survey/000001", what)
    assert journal.recall("survey/000001") == what
    assert journal.recall("survey/000002") is None
    journal.path("survey/000001").write_text('{"low": [')  # a disk that lied
    assert journal.recall("survey/000001") is None
    journal.forget("survey/000001")
    journal.forget("survey/000001")
    assert not journal.path("survey/000001").exists()


def test_a_file_has_its_name_only_when_it_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "a.run"
    synced: list[bool] = []
    monkeypatch.setattr(journal_module.os, "fsync", lambda _: synced.append(path.exists()))
    with new_file(path) as file:
        file.write(b"one")
        assert not path.exists()
        with new_file(path) as other:  # the same unit, somewhere else: neither sees the other's
            other.write(b"other")
        assert path.read_bytes() == b"other"
    assert path.read_bytes() == b"one"
    assert synced == [False, True, True, True]  # the file before it has its name, the folder after
    with pytest.raises(KeyboardInterrupt), new_file(path) as file:
        file.write(b"half")
        raise KeyboardInterrupt
    assert [p.name for p in tmp_path.iterdir()] == ["a.run"]
    assert path.read_bytes() == b"one"


def test_what_has_no_name_is_removed(tmp_path: Path) -> None:
    (tmp_path / "deep").mkdir()
    for name in ("a.tmp", "deep/b.h5.tmp", "deep/c.h5"):
        (tmp_path / name).write_bytes(b"")
    remove_temporaries(tmp_path)
    assert [p.name for p in sorted(tmp_path.rglob("*"))] == ["deep", "c.h5"]


class Counted(Silent):
    """Progress that adds up."""

    done = 0

    def advance(self, amount: int) -> None:
        self.done += amount


@pytest.mark.parametrize("noted", [[], [3], [0, 2, 4], [0, 1, 2, 3, 4]])
def test_what_is_noted_is_not_done_again(noted: list[int], tmp_path: Path) -> None:
    journal, calls = Journal(tmp_path), []

    def square(value: int) -> int:
        calls.append(value)
        return value * value

    for value in noted:
        journal.note(f"work/{value}", {"square": value * value})
    work: Work[int, int] = Work(
        square, lambda r: {"square": r}, lambda noted: noted["square"], lambda r: r != 4
    )
    progress = Counted()
    units = [(f"work/{value}", value) for value in range(5)]
    for _ in range(2):
        with ProcessExecutor(1) as executor:
            assert resumed(journal, executor, work, units, progress, lambda unit: 10) == [0, 1, 4, 9, 16]
    # What 2 was noted for is never there, so it is done each time.
    assert calls == [v for v in range(5) if v not in noted or v == 2] + [2]
    assert progress.done == 100
    recalled: list[Any] = [journal.recall(name) for name, _ in units]
    assert recalled == [{"square": value * value} for value in range(5)]
