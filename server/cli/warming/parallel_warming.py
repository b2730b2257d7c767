"""A child process that warms a scene, last parts first, while this process warms it.

The two share the folder of compiled kernels: one compiles a kernel and the other waits for it
(schemas/kernels/kernel_files.py). Two processes therefore compile everything in about half the time.
A process cannot do so with threads, because numba compiles one function at a time. The child starts
only once there is something to compile.
"""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .child_processes import end_with_parent, lifeline


@contextmanager
def warmed_in_parallel(what: Path) -> Iterator[None]:
    """Let a child compile for `what`, an archive or a scene file, if this block compiles anything.

    The child is stopped at the end of the block.
    """
    from ....schemas.kernels.compiling import on_first_compilation

    children: list[subprocess.Popen[bytes]] = []

    with lifeline() as stdin:

        def start() -> None:
            command = [sys.executable, "-P", "-m", __name__, str(what)]
            nothing = subprocess.DEVNULL
            children.append(subprocess.Popen(command, stdin=stdin, stdout=nothing, stderr=nothing))

        if len(os.sched_getaffinity(0)) > 1:
            on_first_compilation(start)
        try:
            yield
        finally:
            on_first_compilation(None)
            for child in children:
                child.kill()  # what it has not finished, nobody reads
                child.wait()


def main(path: str) -> None:
    """Warm a scene. Errors are reported by the process that serves it."""
    from ....schemas.wire.warming_parts import PARTS
    from ...scene import Scene

    with Scene.open(path) as scene:
        scene.warm(*reversed(PARTS))


if __name__ == "__main__":
    end_with_parent()
    main(sys.argv[1])
