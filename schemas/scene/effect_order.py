"""Order in which the effects of a scene run, and the effects that no budget skips.

server/simulation/effects gives the reasons.
"""

ORDER = (
    "objects", "crowd", "stop", "sweep", "slide", "step", "ground", "proximity", "contacts", "uncertainty",
)  # fmt: skip
# Effects needed for safety: never skipped, whatever a frame's budget.
NEVER_SKIPPED = frozenset({"stop", "sweep", "objects", "crowd"})
