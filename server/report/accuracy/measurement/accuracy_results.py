"""Results of the accuracy report: one kind of row for each of its questions."""

from typing import Any, NamedTuple

# A ratio that differs by more than this factor between two passes does not repeat.
REPEATS = 1.1


class MemoryRow(NamedTuple):
    """A query with an error allowed, with the scene in memory, for one class of poses.

    question: "collide" or "distance".  kind: class of poses, see pose_classes.py.
    share: of all judged poses in that class.
    tolerance: the error allowed [m]; 0: exact.
    time_us: per pose.  ratio, low, high: of its time to that of the exact answer, and the 95 %
    interval.  repeats: whether both passes agree within the factor REPEATS.
    early: share of the class's poses said to be in contact although they are not.
    error_mm: largest distance error; None for `collide`.
    visits: node visits per pose.
    """

    question: str
    kind: str
    share: float
    tolerance: float
    time_us: float
    ratio: float
    low: float
    high: float
    repeats: bool
    early: float
    error_mm: float | None
    visits: float


class FieldRow(NamedTuple):
    """`collide` answered from a Euclidean distance field on a grid, beside the exact answer.

    cell: edge of the grid's cells [m].  kind, share: as in MemoryRow.
    time_us: per pose.  ratio: to the exact answer's.
    false_clear, early: share of the class's poses with the wrong verdict.
    early_if_safe: the same with the threshold that never says clear wrongly.
    field_bytes: of the field measured.  scene_bytes: of one over the box of the whole scene.
    seconds: to make the field.
    """

    cell: float
    kind: str
    share: float
    time_us: float
    ratio: float
    false_clear: float
    early: float
    early_if_safe: float
    field_bytes: int
    scene_bytes: int
    seconds: float


class ColdRow(NamedTuple):
    """`collide` under one pose with nothing in memory, over all places.

    tolerance: the error allowed [m]; None: exact, without the level of detail.
    wait_ms, read_bytes: per pose; read_bytes is None where the system does not count them.
    wait, wait_low, wait_high: total wait relative to that of the first row, with the 95 % interval of
    resampled places.  bytes_ratio, bytes_low, bytes_high: the same of the bytes.
    loaded: share of the poses for which a voxel was loaded; the level settled the others.
    """

    tolerance: float | None
    wait_ms: float
    wait: float
    wait_low: float
    wait_high: float
    read_bytes: float | None
    bytes_ratio: float | None
    bytes_low: float | None
    bytes_high: float | None
    loaded: float


class WalkRow(NamedTuple):
    """A walk with a share of the scene in memory.

    memory: share of the decoded scene.  memory_bytes: the same.
    kind: "exact", which waits for voxels, or "bounds", from the level of detail alone.
    note: why it was not measured; "" if it was.
    frames: number of poses asked.  stalls: those that took longer than a frame.
    longest_ms, median_ms: time of a frame.  read_bytes: of the whole walk, None where unknown.
    early: share of the poses that are clear, and were not said to be.
    false_clear: number of poses said to be clear that are not.
    """

    memory: float
    memory_bytes: int
    kind: str
    note: str = ""
    frames: int = 0
    stalls: int = 0
    longest_ms: float = 0.0
    median_ms: float = 0.0
    read_bytes: int | None = None
    early: float = 0.0
    false_clear: int = 0


class RadiusRow(NamedTuple):
    """A radius model with a factor on its radii.

    model: without the factor.  setting: with it.  scene: "façade", or "sheet" without thickness.
    time_us: of `collide` per pose; None on the sheet.
    doorway_mm: see doorway.py; inf: the figure cannot even stand in the door; None: no figure.
    made_doorway_mm: the same on generated doors; None: not measured.
    leak_p50_mm, leak_p99_mm, leak_worst_mm, passed: see wall_leak.py.
    """

    scene: str
    model: str
    setting: str
    factor: float
    time_us: float | None
    doorway_mm: float | None
    made_doorway_mm: float | None
    leak_p50_mm: float
    leak_p99_mm: float
    leak_worst_mm: float
    passed: float


class FrameRow(NamedTuple):
    """Frames of a walk with the effects stop, sweep, slide, step and ground.

    tolerance: of `sweep` [m].
    time_us, p99_us: of a frame.  ratio, low, high: of the walk's time to that with the first
    tolerance, over pairs of walks.
    way: length of the path that the avatar went [m].
    apart_mm: largest distance of the avatar from where the first tolerance leaves it, one frame from
    the same pose.
    """

    tolerance: float
    time_us: float
    p99_us: float
    ratio: float
    low: float
    high: float
    repeats: bool
    way: float
    apart_mm: float


class Report(NamedTuple):
    """Results of all measurements, in the order of the report's questions.

    facts: about scene, machine and plan, for JSON and the page.
    """

    facts: dict[str, Any]
    memory: list[MemoryRow]
    fields: list[FieldRow]
    cold: list[ColdRow]
    walks: list[WalkRow]
    radii: list[RadiusRow]
    frames: list[FrameRow]

    def as_dict(self) -> dict[str, Any]:
        """Return the report for JSON; infinite values become None."""
        found: dict[str, Any] = {"facts": self.facts}
        for name in self._fields[1:]:
            found[name] = [
                {
                    key: None if value in (float("inf"), float("-inf")) else value
                    for key, value in row._asdict().items()
                }
                for row in getattr(self, name)
            ]
        return found
