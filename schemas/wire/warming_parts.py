"""Parts of a server's work, which become ready one after the other when it starts.

A part is ready once its kernels are compiled, or read from their files. `SceneInfo.compiling` and
`StatsAnswer.compiling` list the others.
"""

from collections.abc import Mapping
from typing import Any

from .question_table import COLLIDE, QUESTIONS

# Operations that move an avatar: `move` and motion commands.
MOTION = "motion"
# Questions with `budget_ms` or `budget_visits`: their searches are kernels of their own.
BUDGETS = "budgets"
# All parts in the order of warming: a server answers `collide` first.
PARTS = (COLLIDE.name, MOTION, *(name for name in QUESTIONS if name != COLLIDE.name), BUDGETS)

# Lines that `solidcloud serve` prints: the first words of the one with which it begins to answer, and
# the one once all parts are ready.
SERVING_WORDS = "serving "
READY_LINE = "all questions are ready"


def needed_parts(operation: str, options: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the parts that a request needs; () if it needs none.

    operation: of its key, or `op` of a path.  options: its parameters.
    """
    part = MOTION if operation == "move" else operation
    if part not in PARTS:
        return ()
    limited = any(options.get(name) is not None for name in ("budget_ms", "budget_visits"))
    return (part, BUDGETS) if limited else (part,)
