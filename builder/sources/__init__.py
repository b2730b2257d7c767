"""One reader a scan format, all behind open_scans(): each gives scans, and a scan gives blocks of points."""

from .files import header_bounds, open_scans, scan_files
from .scan import NOT_FINITE, Block, Lattice, Scan, sha256_of

__all__ = ["NOT_FINITE", "Block", "Lattice", "Scan", "header_bounds", "open_scans", "scan_files", "sha256_of"]
