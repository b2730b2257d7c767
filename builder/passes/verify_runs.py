"""Verification, when a build resumes, that its runs still are byte for byte as written.

A build may resume weeks later, and no later pass would detect corruption: the rows of a run have no
checksum. A flipped bit in a run would produce a valid archive of different points.
"""

from collections.abc import Mapping

from ..resume.build_directory import RUN_FOLDERS, Workplace
from ..run.stages import Stages
from ..spool.spool import RunSums, is_other_run


def check_runs(place: Workplace, stages: Stages) -> None:
    """Read each run named by a journal entry once, before any run is used.

    Forget the entries of runs that differ from what was written, and everything that was made from
    them. A missing run is left to the code that reads the entry (spool_pass.py `RunsHold`).
    """
    noted = {folder: _noted_runs(place, folder) for folder in RUN_FOLDERS}
    total = sum(
        sum(sums[::2]) for notes in noted.values() for runs in notes.values() for sums in runs.values()
    )
    if not total:
        return
    with stages.stage("compare", total, "bytes"):
        for folder, notes in noted.items():
            others = []
            for note, runs in notes.items():
                if any(is_other_run(place.folder / folder / name, sums) for name, sums in runs.items()):
                    others.append(note)
                stages.progress.advance(sum(sum(sums[::2]) for sums in runs.values()))
            if others:
                # This must come first: after a kill in between, the next build finds the same runs
                # and returns here.
                place.distrust_made_of(folder)
                for note in others:
                    place.journal.forget(note)
                return  # the later folders are already forgotten


def _noted_runs(place: Workplace, folder: str) -> dict[str, Mapping[str, RunSums]]:
    """Return the runs that each journal entry of a folder of runs names, by entry."""
    names = sorted(f"{folder}/{path.stem}" for path in (place.folder / folder).glob("*.json"))
    notes = {name: place.journal.recall(name) for name in names}
    return {name: noted["runs"] for name, noted in notes.items() if noted}
