"""Memory that was freed goes back to the system; objects of the start are not examined again."""

import gc
import subprocess
import sys

import pytest
from solidcloud.server.runtime.process_heap import exempt_present_objects

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


@pytest.mark.skipif(sys.platform != "linux", reason="the allocator is glibc's on Linux")
def test_blocks_below_one_that_stays_are_given_back() -> None:
    done = subprocess.run(
        [sys.executable, "-P", "-c", _PROGRAM], capture_output=True, text=True, check=True, timeout=120
    )
    before, full, after = map(float, done.stdout.split())
    assert full - before > 90
    assert after - before < 30


def test_present_objects_are_not_examined_again() -> None:
    cycle: list[object] = []
    cycle.append(cycle)
    try:
        for collect in (False, True):
            exempt_present_objects(collect=collect)
            assert gc.get_freeze_count() > 1000
            assert not any(each is cycle for each in gc.get_objects())
    finally:
        gc.unfreeze()
    assert any(each is cycle for each in gc.get_objects())
