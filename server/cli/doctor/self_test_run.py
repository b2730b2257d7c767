"""Run of the self-test in a child process: a kernel that crashes ends only the child."""

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

from .check import Check, Status, fine
from .kernel_cache_check import cache_folder, count_kernels

# The child may compile all kernels, on a slow machine.
_SECONDS = 900.0
# A first time that takes longer than the second by this much has compiled kernels [s].
_COMPILED_SECONDS = 2.0
# Duration of the second time on a slow machine [s].
_SLOW_SECONDS = 10.0
_NAME = "self-test"


def check_self_test() -> Iterator[Check]:
    """Build and query a small scan in a child process."""
    folder, before = cache_folder(), count_kernels(cache_folder())[0]
    again = f"remove the compiled kernels in {folder} and try again; if that does not help, report it"
    command = [sys.executable, "-P", "-m", f"{__package__}.self_test"]
    begin = time.monotonic()
    try:
        with tempfile.TemporaryDirectory(prefix="solidcloud-doctor-") as scratch:
            done = subprocess.run(
                [*command, scratch], capture_output=True, text=True, timeout=_SECONDS, env=_environment()
            )
    except subprocess.TimeoutExpired:
        yield Check(_NAME, Status.FAULT, f"did not finish within {_SECONDS:g} s", again)
        return
    except OSError as error:
        yield Check(_NAME, Status.FAULT, f"cannot be run: {error}", "see the checks above")
        return
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["without a message"])[-1]
        how = f"exit code {done.returncode}" if done.returncode > 0 else signal.Signals(-done.returncode).name
        yield Check(_NAME, Status.FAULT, f"ended with {how}: {last}", again)
        return
    found = json.loads(done.stdout.strip().splitlines()[-1])
    if found["wrong"]:
        yield Check(_NAME, Status.FAULT, "; ".join(found["wrong"]), again)
        return
    text = (
        f"{found['points']:,} points built and queried in {found['seconds']:.1f} s; collide and distance "
        f"of {found['poses']} poses, {found['contacts']} in contact, equal brute force"
    )
    if found["seconds"] > _SLOW_SECONDS:
        yield Check(_NAME, Status.WARNING, text, "the machine is slow or busy: close other programs")
    else:
        yield fine(_NAME, text)
    new = count_kernels(folder)[0] - before
    compiled = found["first_seconds"] - found["seconds"]
    total = time.monotonic() - begin
    if new > 0 or compiled > _COMPILED_SECONDS:
        kept = f"{new} kernels, which are kept" if new > 0 else "kernels, which are not kept"
        yield Check(
            "compilation", Status.NOTE, f"the self-test compiled {kept}: {compiled:.0f} s of {total:.0f} s"
        )


def _environment() -> dict[str, str]:
    """Return the environment of the child: that of this process, with compiled kernels."""
    return {name: value for name, value in os.environ.items() if name != "NUMBA_DISABLE_JIT"}
