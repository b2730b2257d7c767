"""What the machine and the formats allow, measured beside the builds: reading, writing, hashing and decoding alone."""

import hashlib
import os
import time
from pathlib import Path

import laspy

BLOCK = 8 << 20
# Points decoded at a time: small enough for any cache to hold what a decoder hands on.
CHUNK = 1 << 18


def forget(path: Path) -> bool:
    """Ask the system to drop a file from its cache, so that it is read from the disk; whether it could be asked."""
    if not hasattr(os, "posix_fadvise"):
        return False
    with open(path, "rb") as file:
        os.fsync(file.fileno())  # only clean pages can go
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
    return True


def read_seconds(path: Path) -> float:
    """Read a file from its begin to its end, and do nothing with it."""
    buffer = bytearray(BLOCK)
    begin = time.perf_counter()
    with open(path, "rb", buffering=0) as file:
        while file.readinto(buffer):
            pass
    return time.perf_counter() - begin


def write_seconds(folder: Path, size: int) -> float:
    """Write so many bytes to a new file and have the disk confirm them; the file is removed again."""
    path = folder / "written.tmp"
    block = os.urandom(BLOCK)  # nothing that a file system could make smaller
    begin = time.perf_counter()
    try:
        with open(path, "wb", buffering=0) as file:
            for start in range(0, size, BLOCK):
                file.write(block[: min(BLOCK, size - start)])
            os.fsync(file.fileno())
        return time.perf_counter() - begin
    finally:
        path.unlink(missing_ok=True)


def sha256_seconds(path: Path) -> float:
    """The SHA-256 of a file that is in the system's cache."""
    begin = time.perf_counter()
    with open(path, "rb") as file:
        hashlib.file_digest(file, "sha256")
    return time.perf_counter() - begin


def laz_of(las: Path, laz: Path, points: int) -> Path:
    """The first `points` points of a LAS file as LAZ, all their fields; made once."""
    if not laz.exists():
        temporary = laz.with_suffix(".tmp")
        with laspy.open(las) as source, open(temporary, "wb") as file:
            header = source.header
            with laspy.open(file, "w", header=header, do_compress=True, closefd=False) as target:
                left = points
                for chunk in source.chunk_iterator(1 << 20):
                    target.write_points(chunk[:left])
                    left -= len(chunk)
                    if left <= 0:
                        break
        temporary.rename(laz)
    return laz


def decode_seconds(path: Path, parallel: bool) -> tuple[float, int]:
    """Decode a LAS or LAZ file, chunk by chunk, on one core or on all; seconds and points."""
    backend = laspy.LazBackend.LazrsParallel if parallel else laspy.LazBackend.Lazrs
    begin, points = time.perf_counter(), 0
    with laspy.open(path, laz_backend=backend) as file:
        for chunk in file.chunk_iterator(CHUNK):
            points += len(chunk)
    return time.perf_counter() - begin, points
