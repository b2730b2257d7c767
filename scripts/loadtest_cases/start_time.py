"""Time from a server's command to its first right answer, with the archive's files cached or not."""

import time
from contextlib import ExitStack

import numpy as np
from bench_build_cases.build_limits import forget
from numpy.typing import NDArray
from solidcloud.builder.synthetic.figure import figure_points
from solidcloud.server.client import Client

from . import server_process
from .load_run import Setup
from .user_process import AVATAR

MAX_SECONDS = 900.0


def first_answer(
    setup: Setup, budget: int, pose: NDArray[np.float64], verdict: int, cold: bool
) -> float | None:
    """Return the seconds from the command until a waiting client has the right answer.

    pose: (4, 4).
    verdict: the right one, CLEAR or CONTACT.
    cold: drop the archive's files from the page cache first; returns None where the system cannot.
    Raises ServerError where no right answer came.
    """
    if cold and not all([forget(path) for path in setup.archive.rglob("*") if path.is_file()]):
        return None
    endpoint = server_process.free_endpoint()
    command = server_process.serve_command(setup.archive, endpoint, budget, None)
    with ExitStack() as stack:
        client = stack.enter_context(Client(endpoint, scene=server_process.SCENE, timeout=0.5))
        client.add_avatar(AVATAR, figure_points(setup.points))
        begin = time.monotonic()
        process = stack.enter_context(server_process.started(command, setup.work / "server.log"))
        while time.monotonic() - begin < MAX_SECONDS and process.poll() is None:
            if int(client.collide(AVATAR, pose[None]).verdict[0]) == verdict:
                return time.monotonic() - begin
            time.sleep(0.005)
        raise server_process.ServerError(f"no right answer within {time.monotonic() - begin:.0f} s")
