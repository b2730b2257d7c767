"""Parts of a server's work, which become ready one after the other when it starts.

A part is ready once its kernels are compiled, or read from their files. `SceneInfo.compiling` and
`StatsAnswer.compiling` list the others.
"""

from .question_table import COLLIDE, QUESTIONS, SWEEP

# Operations that move an avatar: `move` and motion commands.
MOTION = "motion"
# All parts in the order of warming: a server answers `collide` first. A second process that compiles
# begins at the end (server/cli/warming/parallel_warming.py), and each process compiles the kernels that
# its own kernels call: sweeps are the kernels of motions.
_FIRST = (COLLIDE.name, MOTION, SWEEP.name)
PARTS = (*_FIRST, *(name for name in reversed(QUESTIONS) if name not in _FIRST))

# Lines that `solidcloud serve` prints: the first words of the one with which it begins to answer, and
# the one once all parts are ready.
SERVING_WORDS = "serving "
READY_LINE = "all questions are ready"


def needed_part(operation: str) -> str:
    """Return the part that a request needs. operation: of its key, or `op` of a path."""
    return MOTION if operation == "move" else operation
