"""Memory of the process: what the allocator returns to the system, what garbage collection examines."""

import ctypes
import gc
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


def exempt_present_objects(*, collect: bool) -> None:
    """Exempt all present objects from garbage collection. collect: after one last collection.

    A full collection holds the interpreter's lock. Over the 150,000 objects of a warm server, most of
    them numba's, it takes 65 ms, during which no request is answered.
    """
    if collect:
        gc.unfreeze()
        gc.collect()
    gc.freeze()
