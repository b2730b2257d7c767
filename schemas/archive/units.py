"""Unit of the integers with which contact is decided exactly ("exact units"), and what a scan may hold.

This module imports nothing, so that readers of points need no kernels.
"""

# 2^-26 m = 15 nm (NUMERICS.md N5). A power of two, so that metres times UNITS_PER_METRE is exact in
# float64.
UNITS_PER_METRE = 2.0**26

# Scan points with world coordinates beyond this [m] are left out, and counted; requests are refused
# (NUMERICS.md, cases 14 and 16).
MAX_COORDINATE = 1e9
# Most scans of an archive that keeps their numbers, and of one file: the column is uint16 (FORMAT.md).
MAX_SCANS = 1 << 16

# A lattice step [m] below 1 micrometre would span fewer than 67 exact units, and no scanner
# resolves it.
MIN_STEP = 1e-6
