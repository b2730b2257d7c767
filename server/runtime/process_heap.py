"""Settings and calls that make the process's memory allocator return memory to the system."""

import ctypes
import sys
from contextlib import suppress

# glibc's parameter numbers, see mallopt(3).
_MMAP_THRESHOLD, _ARENA_MAX = -3, -8
# Larger blocks are returned when they are freed. By default glibc raises this threshold to the
# largest block freed so far, up to 32 MB, and then keeps such blocks, in up to eight arenas a core.
_LARGE_BYTES, _ARENAS = 4 << 20, 2


def give_back_freed_memory() -> None:
    """Return freed memory to the system, if the allocator is glibc's.

    By default glibc keeps all free memory below the last block in use. After a thousand avatars of
    100 KB each were dropped, it kept all of their memory.
    """
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another allocator
            ctypes.CDLL(None).malloc_trim(0)


def give_back_large_blocks() -> None:
    """Make the allocator, if it is glibc's, return large blocks to the system on release."""
    if sys.platform != "linux":
        return
    with suppress(OSError, AttributeError):  # another allocator
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_MMAP_THRESHOLD, _LARGE_BYTES)
        mallopt(_ARENA_MAX, _ARENAS)
