"""Child processes that warm a scene, other parts first, while this process warms it.

All share the folder of compiled kernels: one compiles a kernel and the others wait for it
(schemas/kernels/kernel_files.py). Two processes therefore compile everything in about half the time.
A process cannot do so with threads, because numba compiles one function at a time. The children start
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
    """Let a child for each other core compile for `what`, if this block compiles anything.

    what: an archive or a scene file. The children are stopped at the end of the block.
    """
    from ....schemas.kernels.compiling import on_first_compilation
    from ....schemas.wire.warming_parts import PARTS

    children: list[subprocess.Popen[bytes]] = []
    count = min(len(os.sched_getaffinity(0)), len(PARTS)) - 1

    with lifeline() as stdin:

        def start() -> None:
            command = [sys.executable, "-P", "-m", __name__, str(what)]
            nothing = subprocess.DEVNULL
            for child in range(count):
                last = str(len(PARTS) * (count - child) // count)
                children.append(
                    subprocess.Popen([*command, last], stdin=stdin, stdout=nothing, stderr=nothing)
                )

        on_first_compilation(start)
        try:
            yield
        finally:
            on_first_compilation(None)
            for child in children:
                child.kill()  # what it has not finished, nobody reads
                child.wait()


def main(path: str, last: int) -> None:
    """Warm a scene, from the part before number `last` backwards.

    Errors are reported by the process that serves it.
    """
    from ....schemas.wire.warming_parts import PARTS
    from ...scene import Scene

    with Scene.open(path) as scene:
        scene.warm(*reversed(PARTS[last:] + PARTS[:last]))


if __name__ == "__main__":
    end_with_parent()
    main(sys.argv[1], int(sys.argv[2]))
