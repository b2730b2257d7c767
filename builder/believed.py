"""What a build that goes on believes of the runs it finds: those that are, byte for byte, what was written.

A build may go on weeks later, and no pass could tell: a row of a run has no checksum of its own, and what is made of a
bit that changed is a sound archive of other points.
"""

from collections.abc import Mapping

from .spool import RUN_FOLDERS, RunSums, is_other_run
from .stages import Stages
from .workplace import Workplace


def check_runs(place: Workplace, stages: Stages) -> None:
    """Read each run that a note speaks of, once; forget what is not what was written, and what was made of it.

    Asked before any of them is used. One that is missing is left to whoever reads the note (partition.py `RunsHold`).
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
                # First: killed in between, the next build finds the runs as they are, and comes here again.
                place.distrust_made_of(folder)
                for note in others:
                    place.journal.forget(note)
                return  # what comes after is forgotten


def _noted_runs(place: Workplace, folder: str) -> dict[str, Mapping[str, RunSums]]:
    """Note -> the runs it speaks of, of all notes in a folder of runs."""
    names = sorted(f"{folder}/{path.stem}" for path in (place.folder / folder).glob("*.json"))
    notes = {name: place.journal.recall(name) for name in names}
    return {name: noted["runs"] for name, noted in notes.items() if noted}
