"""How the process's memory allocator gives memory back to the system."""

import ctypes
import sys
from contextlib import suppress

# glibc's numbers of the settings, see mallopt(3).
_MMAP_THRESHOLD, _ARENA_MAX = -3, -8
# Blocks of more bytes are given back when they are freed. By default glibc raises this to the largest block freed so
# far, up to 32 MB, and then keeps such blocks, in up to eight arenas a core.
_LARGE_BYTES, _ARENAS = 4 << 20, 2


def give_back_freed_memory() -> None:
    """Give the memory that was freed back to the system, where the allocator is glibc's.

    By itself it keeps what lies below the last block in use: all of a thousand avatars of 100 KB that were forgotten.
    """
    if sys.platform == "linux":
        with suppress(OSError, AttributeError):  # another allocator
            ctypes.CDLL(None).malloc_trim(0)


def give_back_large_blocks() -> None:
    """Have large blocks of memory given back to the system when they are freed, where the allocator is glibc's."""
    if sys.platform != "linux":
        return
    with suppress(OSError, AttributeError):  # another allocator
        mallopt = ctypes.CDLL(None).mallopt
        mallopt(_MMAP_THRESHOLD, _LARGE_BYTES)
        mallopt(_ARENA_MAX, _ARENAS)
