"""Readers of scan formats, one file per format, all behind open_scans().

Each reader returns Scan objects; a Scan yields its points in blocks.
"""

from .files import header_bounds, open_scans, scan_files
from .placed import METRES, TURNS, placed
from .scan import NO_RETURN, NOT_FINITE, Block, Lattice, Scan, sha256_of

__all__ = [
    "METRES", "NOT_FINITE", "NO_RETURN", "TURNS", "Block", "Lattice", "Scan", "header_bounds", "open_scans", "placed",
    "scan_files", "sha256_of",
]  # fmt: skip
