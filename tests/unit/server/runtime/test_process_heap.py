"""Memory that was freed goes back to the system."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="the allocator is glibc's on Linux")

# A thousand blocks of 100 KB below one that stays.
_PROGRAM = """
import os
from pathlib import Path
import numpy as np
from solidcloud.server.runtime.process_heap import give_back_freed_memory, give_back_large_blocks

def held():
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

give_back_large_blocks()
before = held()
blocks = [np.ones(12_800) for _ in range(1000)]
last = np.ones(12_800)
full = held()
del blocks
give_back_freed_memory()
print(before, full, held())
"""


def test_blocks_below_one_that_stays_are_given_back() -> None:
    done = subprocess.run(
        [sys.executable, "-P", "-c", _PROGRAM], capture_output=True, text=True, check=True, timeout=120
    )
    before, full, after = map(float, done.stdout.split())
    assert full - before > 90
    assert after - before < 30
