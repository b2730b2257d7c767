"""Time from a server's command to its first right answer, with the archive's files cached or not."""

import time
from contextlib import ExitStack

import numpy as np
from numpy.typing import NDArray

from .....schemas.wire.answers import Verdict
from ....client import Client
from ...common.machine import drop_from_page_cache
from ..users.user_process import AVATAR
from . import load_server
from .load_run import Setup

MAX_SECONDS = 900.0


def first_answer(
    setup: Setup, budget: int, pose: NDArray[np.float64], verdict: int | None, cold: bool
) -> float | None:
    """Return the seconds from the command until a waiting client has the right answer.

    pose: (4, 4).
    verdict: the right one, CLEAR or CONTACT; None: not known, any but UNKNOWN.
    cold: drop the archive's files from the page cache first; returns None where the system cannot.
    Raises ServerError where no right answer came.
    """
    if cold and not all([drop_from_page_cache(path) for path in setup.archive.rglob("*") if path.is_file()]):
        return None
    endpoint = load_server.free_endpoint()
    command = load_server.serve_command(setup.archive, endpoint, budget, None)
    with ExitStack() as stack:
        client = stack.enter_context(Client(endpoint, scene=load_server.SCENE, timeout=0.5))
        client.add_avatar(AVATAR, setup.avatar)
        begin = time.monotonic()
        process = stack.enter_context(load_server.started(command, setup.work / "server.log"))
        while time.monotonic() - begin < MAX_SECONDS and process.poll() is None:
            said = int(client.collide(AVATAR, pose[None]).verdict[0])
            if said == verdict or (verdict is None and said != Verdict.UNKNOWN):
                return time.monotonic() - begin
            time.sleep(0.005)
        raise load_server.ServerError(f"no right answer within {time.monotonic() - begin:.0f} s")
