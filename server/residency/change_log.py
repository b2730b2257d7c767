"""Latest change of each voxel of a cache since a reader last took them, bounded in size."""

from ...schemas.wire.residency_messages import MAX_CHANGED_VOXELS, Residency


class ChangeLog:
    """Changes of one cache for one reader. Not thread-safe: `VoxelCache` guards it with its lock.

    changes: state of each changed voxel by index row.  overflowed: whether more voxels changed.
    """

    __slots__ = ("changes", "overflowed")

    def __init__(self) -> None:
        """Begin without changes."""
        self.changes: dict[int, Residency] = {}
        self.overflowed = False

    def add(self, row: int, state: Residency) -> None:
        """Note a change; a further one of the same voxel replaces it."""
        if len(self.changes) < MAX_CHANGED_VOXELS or row in self.changes:
            self.changes[row] = state
        else:
            self.overflowed = True

    def take(self) -> tuple[dict[int, Residency], bool]:
        """Return the changes and whether some are missing, and begin anew."""
        found = self.changes, self.overflowed
        self.changes, self.overflowed = {}, False
        return found
