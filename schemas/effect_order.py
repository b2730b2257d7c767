"""The order in which the effects of a scene run, and those that no budget skips; server/effects says why."""

ORDER = (
    "objects", "crowd", "stop", "sweep", "slide", "step", "ground", "proximity", "contacts", "uncertainty",
)  # fmt: skip
# What safety asks for: never skipped, whatever a frame's budget.
NEVER_SKIPPED = frozenset({"stop", "sweep", "objects", "crowd"})
