"""Child processes that warm a scene, other parts first, while this process warms it.

All share the folder of compiled kernels: one compiles a kernel and the others wait for it
(schemas/runtime/kernel_files.py). Two processes therefore compile everything in little more than half
the time: what kernels of both call, both compile. A process cannot do so with threads, because numba
compiles one function at a time. The children start only once there is something to compile.
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
    from ....schemas.runtime.compiling import on_first_compilation
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
    """Warm an archive, from the part before number `last` backwards.

    Of a scene file this is the first archive: to make its effects compiles the kernels of their frames at
    once, which the process that serves does. That process also reports errors.
    """
    from ....schemas.scene.scene_file import read_scene
    from ....schemas.wire.warming_parts import PARTS
    from ...scene import Scene

    what = Path(path)
    archive = what if what.is_dir() else what.parent / read_scene(what).archives[0].path
    with Scene.open(archive) as scene:
        scene.warm(*reversed(PARTS[last:] + PARTS[:last]))


if __name__ == "__main__":
    end_with_parent()
    main(sys.argv[1], int(sys.argv[2]))
