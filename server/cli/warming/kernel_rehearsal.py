"""Trial of the compiled kernels in a child process, after a server start that did not complete.

A digest shows that a kernel file holds what was written. It cannot show that its contents are right
for this machine. Therefore a server marks its start (`KernelFiles.starting`). If the previous start
did not complete, a child process first performs everything that a start does. If the child crashes,
hangs or computes a wrong answer, all compiled kernels are removed, delivered ones are used no longer,
and all are compiled again. A start that follows a complete one skips the trial.

A wrong kernel may also make the check of a sound record fail. If the child finds a fault of the
archive or scene file, a second child therefore looks for it with kernels that it compiles itself.
If it finds the same fault, the kernels are kept, and the start reports the fault.
"""

import logging
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ....schemas.errors import CorruptError, SolidcloudError
from ....schemas.runtime.kernel_files import KernelFiles, default_folder
from ....schemas.wire.answers import Verdict
from .child_processes import end_with_parent, lifeline

if TYPE_CHECKING:
    from ...scene import Scene

log = logging.getLogger(__name__)

# The child may have to compile all kernels, on a slow machine.
SECONDS = 900.0
# Exit code of a child that finds a fault of the archive or scene file.
_DATA_FAULT = 3
_CLIENT = "rehearsal"
_RADIUS, _REACH = 0.05, 0.5


def rehearse(what: Path, files: KernelFiles, seconds: float = SECONDS) -> None:
    """Open and warm `what`, an archive or a scene file, in a child process.

    Removes all compiled kernels if the child fails or takes longer than `seconds`, or if it finds a
    fault of `what` that a child without these kernels does not find.
    """
    fault, data_fault = _run_trial(what, seconds, os.environ)
    if data_fault:
        with tempfile.TemporaryDirectory() as folder:
            KernelFiles(default_folder(folder)).remove_all()  # so that delivered ones are not used
            again = _run_trial(what, seconds, {**os.environ, "NUMBA_CACHE_DIR": folder})
        if again == ("", data_fault):
            return
        fault = f"found a fault that newly compiled ones do not find ({data_fault})"
    if not fault:
        return
    files.remove_all()
    log.warning(
        "compiled kernels in %s: the last server start did not complete, and a trial of the kernels %s: "
        "all were removed and are compiled again",
        files.folder,
        fault,
    )


def _run_trial(what: Path, seconds: float, environment: Mapping[str, str]) -> tuple[str, str]:
    """Run `main` in a child process.

    Returns how the child failed, and the fault of `what` that it found; "" for neither.
    """
    command = [sys.executable, "-P", "-m", __name__, str(what)]
    try:
        with lifeline() as stdin:
            done = subprocess.run(command, stdin=stdin, capture_output=True, timeout=seconds, env=environment)
    except subprocess.TimeoutExpired:
        return f"did not finish within {seconds:g} s", ""
    code = done.returncode
    if code == _DATA_FAULT:
        return "", done.stdout.decode(errors="replace").strip()
    if code < 0:
        return f"ended with {signal.Signals(-code).name}", ""
    return (f"ended with exit code {code}", "") if code else ("", "")


def check_answers(scene: "Scene") -> None:
    """Make queries whose answers are known.

    Raises AssertionError if a kernel computes a wrong one, CorruptError if a record cannot be read.

    Checks that `collide` and `distance`, which use different kernels, agree at the corners and the
    centre of the scene's bounds; that a sphere around a scan point is in contact; and that there is
    no point far outside the bounds.
    """
    low, high = (np.array(bound) for bound in scene.info().bounds)
    scene.add_avatar(_CLIENT, [[0.0, 0.0, 0.0]], _RADIUS, client=_CLIENT)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
    places = np.vstack([corners, (low + high) / 2, high + 2 * _REACH])
    found = scene.distance(_CLIENT, _poses(places), _REACH, client=_CLIENT)
    collided = scene.collide(_CLIENT, _poses(places), 0.0, client=_CLIENT)
    if faults := found.faults or collided.faults:
        raise CorruptError("; ".join(faults))
    touches = collided.verdict == Verdict.CONTACT
    _require(np.array_equal(touches, found.signed_distance <= 0), "collide and distance disagree")
    _require(not touches[-1] and found.signed_distance[-1] == np.inf, "a point is found where there is none")
    points = found.witness_cloud[~np.isnan(found.witness_cloud[:, 0])]
    if len(points):
        verdicts = scene.collide(_CLIENT, _poses(points), 0.0, client=_CLIENT).verdict
        _require(bool(np.all(verdicts == Verdict.CONTACT)), "no contact at a scan point")


def _poses(places: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return upright poses (k, 4, 4) at places (k, 3), world frame [m]."""
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    return poses


def _require(holds: bool, fault: str) -> None:
    """Raise AssertionError with this message unless `holds`; unlike `assert`, also under -O."""
    if not holds:
        raise AssertionError(fault)


def main(path: str) -> int:
    """Open, warm and check the scene as a server start does.

    Returns 0, or _DATA_FAULT with the fault of the archive or scene file on the standard output.
    """
    from ...scene import Scene

    try:
        with Scene.open(path) as scene:
            scene.warm()
            check_answers(scene)
    except SolidcloudError as error:
        sys.stdout.buffer.write(str(error).encode(errors="backslashreplace"))
        return _DATA_FAULT
    return 0


if __name__ == "__main__":
    end_with_parent()
    sys.exit(main(sys.argv[1]))
