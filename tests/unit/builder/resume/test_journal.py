"""Journal entries are written whole or not at all, and units with an entry are not run again."""

from pathlib import Path
from typing import Any

import pytest
from solidcloud.builder.resume.kept_work import Journal, Work, run_unfinished
from solidcloud.builder.run.executor import ProcessExecutor
from solidcloud.builder.run.progress import Silent


def test_a_file_is_forgotten_by_its_name(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    journal.write_entry("spool/1", {"runs": {"a.run": [1, 2], "b.run": [3, 4]}})
    journal.write_entry("done/1", {"name": "0-1.h5"})
    journal.write_entry("done/2", {"name": "0-2.h5"})
    journal.write_entry("survey/1", ["a.run"])
    journal.remove_entries_of(tmp_path / "spool" / "b.run")
    journal.remove_entries_of(tmp_path / "archive" / "0-2.h5")
    left = ["spool/1", "done/1", "done/2", "survey/1"]
    assert [name for name in left if journal.read_entry(name)] == ["done/1", "survey/1"]


def test_a_note_is_recalled_as_it_was(tmp_path: Path) -> None:
    journal = Journal(tmp_path)
    what = {"low": [float("inf"), 0.1, -1e300], "text": "Größe", "nested": {"a": [1, None]}}
    journal.write_entry("survey/000001", what)
    assert journal.read_entry("survey/000001") == what
    assert journal.read_entry("survey/000002") is None
    journal.path("survey/000001").write_text('{"low": [')  # a disk that lied
    assert journal.read_entry("survey/000001") is None
    journal.remove_entry("survey/000001")
    journal.remove_entry("survey/000001")
    assert not journal.path("survey/000001").exists()


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
        journal.write_entry(f"work/{value}", {"square": value * value})
    work: Work[int, int] = Work(
        square, lambda r: {"square": r}, lambda noted: noted["square"], lambda r: r != 4
    )
    progress = Counted()
    units = [(f"work/{value}", value) for value in range(5)]
    for _ in range(2):
        with ProcessExecutor(1) as executor:
            assert run_unfinished(journal, executor, work, units, progress, lambda unit: 10) == [
                0,
                1,
                4,
                9,
                16,
            ]
    # What 2 was noted for is never there, so it is done each time.
    assert calls == [v for v in range(5) if v not in noted or v == 2] + [2]
    assert progress.done == 100
    recalled: list[Any] = [journal.read_entry(name) for name, _ in units]
    assert recalled == [{"square": value * value} for value in range(5)]
