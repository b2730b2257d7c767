"""Trial of the compiled kernels in a child process, after a server start that did not complete.

A digest shows that a kernel file holds what was written. It cannot show that its contents are right
for this machine. Therefore a server marks its start (`KernelFiles.starting`). If the previous start
did not complete, a child process first performs everything that a start does. If the child crashes,
hangs or computes a wrong answer, all compiled kernels are removed and compiled again. A start that
follows a complete one skips the trial.
"""

import logging
import signal
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ....schemas.errors import SolidcloudError
from ....schemas.kernels.kernel_files import KernelFiles
from ....schemas.wire.answers import Verdict

if TYPE_CHECKING:
    from ...scene import Scene

log = logging.getLogger(__name__)

# The child may have to compile all kernels, on a slow machine.
SECONDS = 900.0
_CLIENT = "rehearsal"
_RADIUS, _REACH = 0.05, 0.5


def rehearse(what: Path, files: KernelFiles, seconds: float = SECONDS) -> None:
    """Open and warm `what`, an archive or a scene file, in a child process.

    Removes all compiled kernels if the child fails or takes longer than `seconds`.
    """
    command = [sys.executable, "-P", "-m", __name__, str(what)]
    try:
        code = subprocess.run(command, capture_output=True, timeout=seconds).returncode
    except subprocess.TimeoutExpired:
        fault = f"did not finish within {seconds:g} s"
    else:
        if code == 0:
            return
        fault = f"ended with {signal.Signals(-code).name if code < 0 else f'exit code {code}'}"
    files.remove_all()
    log.warning(
        "compiled kernels in %s: the last server start did not complete, and a trial of the kernels %s: "
        "all were removed and are compiled again",
        files.folder,
        fault,
    )


def check_answers(scene: "Scene") -> None:
    """Make queries whose answers are known. Raises AssertionError if a kernel computes a wrong one.

    Checks that `collide` and `distance`, which use different kernels, agree at the corners and the
    centre of the scene's bounds; that a sphere around a scan point is in contact; and that there is
    no point far outside the bounds.
    """
    low, high = (np.array(bound) for bound in scene.info().bounds)
    scene.add_avatar(_CLIENT, [[0.0, 0.0, 0.0]], _RADIUS, client=_CLIENT)
    corners = np.stack(np.meshgrid(*zip(low, high, strict=True)), axis=-1).reshape(-1, 3)
    places = np.vstack([corners, (low + high) / 2, high + 2 * _REACH])
    found = scene.distance(_CLIENT, _poses(places), _REACH, client=_CLIENT)
    touches = scene.collide(_CLIENT, _poses(places), 0.0, client=_CLIENT).verdict == Verdict.CONTACT
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
    """Open, warm and check the scene as a server start does. Return 0 unless the kernels fail."""
    from ...scene import Scene

    try:
        with Scene.open(path) as scene:
            scene.warm()
            scene.simulation.warm()
            check_answers(scene)
    except SolidcloudError:
        return 0  # a fault of the archive or scene file, which the server start itself reports
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
