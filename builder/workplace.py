"""The folder that an archive is made in, and how it gets the name asked for: locked, hidden, renamed when whole.

A failure leaves nothing behind, and what a killed build left is removed by the next one of the same name.
"""

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ..schemas.archive import INDEX_NAME, SHARD_FOLDER, sync_folder
from ..schemas.errors import BadRequestError


def _check_target(target: Path, overwrite: bool) -> None:
    """Refuse to write where something else is."""
    if not target.exists() or (target.is_dir() and not any(target.iterdir())):
        return
    if not (target / INDEX_NAME).is_file():
        raise BadRequestError(f"{target}: exists and is no archive, expected a new folder: give another -o")
    if not overwrite:
        raise BadRequestError(f"{target}: an archive is here already: give another -o, or --overwrite")
    shards = list((target / SHARD_FOLDER).iterdir()) if (target / SHARD_FOLDER).is_dir() else []
    strangers = [p for p in target.iterdir() if p.name not in (INDEX_NAME, SHARD_FOLDER)]
    strangers += [p for p in shards if p.suffix != ".h5" or not p.is_file()]
    if strangers:
        raise BadRequestError(
            f"{strangers[0]}: not part of an archive, and --overwrite would delete it: move it, or give another -o"
        )


@contextmanager
def made_parents(target: Path) -> Iterator[None]:
    """Make the folders above the target; after a failure, remove those that were made here."""
    made = [folder for folder in target.parents if not folder.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        yield
    except BaseException:
        for folder in made:
            with suppress(OSError):  # somebody else uses it by now
                folder.rmdir()
        raise


@contextmanager
def locked(target: Path) -> Iterator[None]:
    """Keep a second builder off the same target."""
    path = target.parent / f".{target.name}.lock"
    while True:
        file = open(path, "w")  # noqa: SIM115  held open as long as the lock
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            file.close()
            raise BadRequestError(
                f"{target}: another build is writing it: wait for it, or give another -o"
            ) from None
        # The holder before us may have removed the file we just locked: then lock the one that is there now.
        if path.exists() and os.fstat(file.fileno()).st_ino == path.stat().st_ino:
            break
        file.close()
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        file.close()


@contextmanager
def workplace(target: Path, overwrite: bool) -> Iterator[Path]:
    """The hidden folder that the archive is made in; what an earlier, killed build left there goes first."""
    _recover(target)
    _check_target(target, overwrite)
    folder = target.parent / f".{target.name}.building"
    shutil.rmtree(folder, ignore_errors=True)
    (folder / SHARD_FOLDER).mkdir(parents=True)
    (folder / "spool").mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _recover(target: Path) -> None:
    """Finish what an earlier build with `overwrite` left when it was killed between its two renames."""
    old = target.parent / f".{target.name}.old"
    if old.exists() and not target.exists():
        os.rename(old, target)
    shutil.rmtree(old, ignore_errors=True)


def publish_folder(folder: Path, target: Path, overwrite: bool) -> None:
    """Give the finished folder its name."""
    sync_folder(folder)
    if target.exists() and overwrite and (target / INDEX_NAME).is_file():
        old = target.parent / f".{target.name}.old"
        os.rename(target, old)
        try:
            os.rename(folder, target)
        except OSError:
            os.rename(old, target)
            raise
        shutil.rmtree(old)
    else:
        os.rename(folder, target)  # replaces an empty folder
    sync_folder(target.parent)
