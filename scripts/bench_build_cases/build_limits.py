"""Limits of machine and formats, measured beside the builds: reading, writing, hashing, decoding alone."""

import hashlib
import os
import time
from pathlib import Path

import laspy

BLOCK = 8 << 20
# Points decoded at a time: few enough for a decoder's output to stay in any cache.
CHUNK = 1 << 18


def read_seconds(path: Path) -> float:
    """Time reading a file from start to end."""
    buffer = bytearray(BLOCK)
    begin = time.perf_counter()
    with open(path, "rb", buffering=0) as file:
        while file.readinto(buffer):
            pass
    return time.perf_counter() - begin


def write_seconds(folder: Path, size: int) -> float:
    """Time writing this many bytes to a new file with the disk confirming them; removes the file."""
    path = folder / "written.tmp"
    block = os.urandom(BLOCK)  # incompressible for any file system
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
    """Time the SHA-256 of a file in the page cache."""
    begin = time.perf_counter()
    with open(path, "rb") as file:
        hashlib.file_digest(file, "sha256")
    return time.perf_counter() - begin


def laz_of(las: Path, laz: Path, points: int) -> Path:
    """Return the first `points` points of a LAS file as LAZ with all fields; created once."""
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
    """Decode a LAS or LAZ file chunk by chunk, on one core or on all; return seconds and points."""
    backend = laspy.LazBackend.LazrsParallel if parallel else laspy.LazBackend.Lazrs
    begin, points = time.perf_counter(), 0
    with laspy.open(path, laz_backend=backend) as file:
        for chunk in file.chunk_iterator(CHUNK):
            points += len(chunk)
    return time.perf_counter() - begin, points
