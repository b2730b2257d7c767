"""Cache budgets of a load test, checked against the archive before anything runs."""

import math
import os
from collections.abc import Sequence

from .....schemas.errors import BadRequestError
from ..users.archive_voxels import Voxels

# Share of the machine's memory that a cache, or a scene with everything resident, may take.
MEMORY_SHARE = 0.5


def least_share(voxels: Voxels) -> float:
    """Return the least share of the decoded bytes with which a server starts: that of the largest voxel."""
    return min(1.0, math.ceil(1000 * int(voxels.sizes.max()) / voxels.decoded) / 1000)


def checked_shares(
    usual: Sequence[float], given: Sequence[float] | None, voxels: Voxels, option: str
) -> tuple[list[float], str]:
    """Return the budgets to measure, as shares of the decoded bytes, and a remark about changed ones.

    usual: the default; shares that are too small for this archive are raised to the least possible.
    given: by the user, or None.
    Raises BadRequestError for a given share that is too small, or not a share.
    """
    least = least_share(voxels)
    smallest = f"the largest voxel takes {int(voxels.sizes.max()) / 2**20:,.3g} MB, {least:g} of the archive"
    for share in given or ():
        if not 0 < share < math.inf:
            raise BadRequestError(f"{option} {share:g}: expected a positive share of the decoded archive")
        if share < least:
            raise BadRequestError(
                f"{option} {share:g}: {smallest}: give at least {least:g}, or build smaller voxels"
            )
    if given:
        return list(given), ""
    shares = sorted({max(share, least) for share in usual})
    if shares == sorted(usual):
        return shares, ""
    return shares, f"{option}: {smallest}: budgets are {', '.join(f'{share:g}' for share in shares)}"


def fits_memory(size: int) -> bool:
    """Return whether this many bytes may be held in memory; True where the machine does not say."""
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (ValueError, OSError):
        return True
    return total <= 0 or size <= MEMORY_SHARE * total
