"""Builds of an interpreted test run in a compiled process: the archives of tests whose subject is not the builder.

An interpreted build takes seconds and a compiled one tenths, of the same bytes (test_answers.py, case 24). Tests of
the builder build in their own process: they ask for the fixture `builds_here`, or do not use kept_archives.py.
"""

import atexit
import functools
import os
import pickle
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from sample_sizes import MANY
from solidcloud.builder.config import BuildConfig

INTERPRETED = os.environ.get("NUMBA_DISABLE_JIT") == "1"
_SERVE = """
import pickle, sys
from solidcloud.builder.pipeline import build_archive

asked, told = sys.stdin.buffer, sys.stdout.buffer
sys.stdout = sys.stderr
while True:
    try:
        request = pickle.load(asked)
    except EOFError:
        break
    try:
        build_archive(*request)
        failed = None
    except Exception as error:
        failed = repr(error)
    pickle.dump(failed, told)
    told.flush()
"""
# Whether builds of an interpreted run are made in this process: a test may set it.
here = MANY


def build_compiled(scans: Sequence[Path], target: Path, config: BuildConfig) -> bool:
    """Build an archive in another process, which compiles. Return False where it is to be built here.

    A build that fails there is to be repeated here, where its error is raised.
    """
    if here or not INTERPRETED:
        return False
    process = _process()
    assert process.stdin is not None and process.stdout is not None
    pickle.dump((list(scans), target, config), process.stdin)
    process.stdin.flush()
    return pickle.load(process.stdout) is None


@functools.cache
def _process() -> "subprocess.Popen[bytes]":
    """Start the process, once. It ends with this one."""
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_DISABLE_JIT"}
    process = subprocess.Popen(
        [sys.executable, "-P", "-W", "ignore", "-c", _SERVE],
        env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    atexit.register(process.kill)
    return process
