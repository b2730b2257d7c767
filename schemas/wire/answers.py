"""Answer types: structs of arrays with one element per pose, ray, point or motion.

`Scene` and `Client` both return these types. This module imports neither zenoh nor numba, and does
not know the wire's encodings.
"""

from collections.abc import Callable, Iterator
from enum import IntEnum
from typing import Any, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from .arrays import IndexPairs, Positions

# Columns without rows. A view of one takes a third of the time of a new array.
_NO_BOUNDS, _NO_FLAGS = np.empty(0), np.empty(0, bool)


class Verdict(IntEnum):
    """Verdict on a pose. `CLEAR` only if everything in reach was examined (NUMERICS.md case 21)."""

    CLEAR = 0
    CONTACT = 1
    UNKNOWN = 2


class AnswerForms(NamedTuple):
    """Functions that describe answers: as one line of text, and as values for JSON."""

    line: Callable[[Any], str]
    values: Callable[[Any], dict[str, Any]]


# Set by question_table.py: both read the questions' declarations, which import this module.
_forms: list[AnswerForms] = []


def use_forms(forms: AnswerForms) -> None:
    """Set the functions that describe answers of every type."""
    _forms[:] = [forms]


class Cost(msgspec.Struct, frozen=True, eq=False, kw_only=True):
    """Cost of a whole request, and its effect on the cache. Every answer has these fields.

    `repr` and `str` are one line, such as "70 poses: 68 clear, 2 contact, 0 unknown; 0.3 ms".
    engine_seconds: time between request and answer inside the engine, loads included [s].
    hits: voxels in reach that were resident.  misses: voxels that were loaded for this request.
    resident, resident_bytes: voxels decoded in memory after this request, and their bytes.
    faults: one sentence for each voxel that could not be read, with place and reason.
    wait_seconds: the part of engine_seconds spent waiting for voxels [s].
    late: keys of the voxels that missed the deadline of the budget. Answers that depend on them are
    `UNKNOWN`; their loads continue.
    stopped: why the request was stopped before everything was examined; empty if it was not.
    """

    engine_seconds: float = 0.0
    hits: int = 0
    misses: int = 0
    resident: int = 0
    resident_bytes: int = 0
    faults: tuple[str, ...] = ()
    wait_seconds: float = 0.0
    late: tuple[int, ...] = ()
    stopped: str = ""

    def __repr__(self) -> str:
        """Return the number of answers of each verdict, what else matters, and the time."""
        return _forms[0].line(self) if _forms else f"<{type(self).__name__}>"

    def to_dict(self) -> dict[str, Any]:
        """Return the answers as dicts, lists, numbers and strings, ready for `json.dumps`.

        "answers" has one dict per pose, ray, point, motion or object, with the columns by name and
        the verdict as "clear", "contact" or "unknown". Infinite and NaN values are None. The other
        keys are about the whole request. `solidcloud query --json` prints the same.
        """
        if not _forms:
            raise TypeError(f"{type(self).__name__}: import solidcloud.schemas.wire.question_table first")
        return _forms[0].values(self)


class CollideAnswer(NamedTuple):
    """Answer for one pose; see `CollideAnswers` for the fields."""

    verdict: Verdict
    outside: bool
    voxels_missing: int
    node_visits: int
    point_tests: int


class CollideAnswers(Cost, frozen=True, eq=False):
    """Answers of `collide` for k poses, in their order.

    Iteration yields one `CollideAnswer` per pose.
    verdict: (k,) uint8, values of `Verdict`.
    outside: (k,) bool, whether the reach extends beyond the dataset's bounds.
    voxels_missing: (k,) uint32, voxels in reach that could not be examined.
    node_visits: (k,) uint32, pairs of bounding spheres tested.
    point_tests: (k,) uint32, pairs of points tested.
    lower, upper: (k,) float64, bounds of the signed distance [m].
    exact: (k,) bool, whether the verdict is that of tolerance 0.
    The last three are empty if neither a tolerance nor a budget was given; every verdict but
    `UNKNOWN` is exact then.
    """

    verdict: NDArray[np.uint8]
    outside: NDArray[np.bool_]
    voxels_missing: NDArray[np.uint32]
    node_visits: NDArray[np.uint32]
    point_tests: NDArray[np.uint32]
    lower: NDArray[np.float64] = msgspec.field(default_factory=_NO_BOUNDS.view)
    upper: NDArray[np.float64] = msgspec.field(default_factory=_NO_BOUNDS.view)
    exact: NDArray[np.bool_] = msgspec.field(default_factory=_NO_FLAGS.view)

    def __len__(self) -> int:
        """Return the number of poses answered."""
        return len(self.verdict)

    def __iter__(self) -> Iterator[CollideAnswer]:
        """Yield one answer per pose, in order."""
        columns = (self.verdict, self.outside, self.voxels_missing, self.node_visits, self.point_tests)
        for verdict, outside, missing, visits, tests in zip(*columns, strict=True):
            yield CollideAnswer(Verdict(int(verdict)), bool(outside), int(missing), int(visits), int(tests))


class DistanceAnswers(Cost, frozen=True, eq=False):
    """Answers of `distance` for k poses, in their order.

    signed_distance: (k,) float64, least |a - b| - r_a - r_b of a pair within reach [m]; negative if
    they overlap; inf if no pair is within reach. Where not exact, that of the best pair found.
    lower, upper: (k,) float64, bounds of the true signed distance [m]; if it is beyond reach,
    `lower` is the reach and `upper` inf.
    exact: (k,) bool, whether `signed_distance` is the true one, or nothing is within reach.
    verdict: (k,) uint8: CONTACT if `upper` <= 0; CLEAR if the pair's integers or `lower` prove that
    nothing touches; else UNKNOWN.
    witness_avatar, witness_cloud: (k, 3) float64, the centres of the nearest pair, world [m]; NaN
    if there is none. Among pairs at equal distance, the one with the least scan point (x, y, z),
    then the least avatar centre.
    normal: (k, 3) float64, contact normal: unit vector from `witness_cloud` to `witness_avatar`;
    zero if they coincide, NaN if there is no pair.
    outside, voxels_missing, node_visits, point_tests: as in `CollideAnswers`.
    """

    verdict: NDArray[np.uint8]
    signed_distance: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    exact: NDArray[np.bool_]
    witness_avatar: Positions
    witness_cloud: Positions
    normal: Positions
    outside: NDArray[np.bool_]
    voxels_missing: NDArray[np.uint32]
    node_visits: NDArray[np.uint32]
    point_tests: NDArray[np.uint32]

    def __len__(self) -> int:
        """Return the number of poses answered."""
        return len(self.verdict)


class ContactsAnswers(Cost, frozen=True, eq=False):
    """Answers of `contacts` for k poses: pairs in contact, and their clusters.

    verdict, outside, voxels_missing, node_visits, point_tests: (k,), as in `CollideAnswers`.
    exact: (k,) bool, whether all pairs in contact were counted.
    pairs_found: (k,) int64, pairs in contact, listed or not.
    pair_starts: (k + 1,) int64. The pairs listed for pose i are rows [pair_starts[i], pair_starts[i
    + 1]) of the pair columns, deepest first, ties by scan point (x, y, z), then by avatar centre:
    avatar_point, cloud_point: (p, 3) float64, centres, world [m].
    signed_distance: (p,) float64 [m].
    avatar_index: (p,) int32, row of the avatar's points as added.
    scan_index: (p,) int32, scan of the scan point (`SceneInfo.sources`), -1 if not kept.
    cluster: (p,) int32, row among the pose's clusters.
    cluster_starts: (k + 1,) int64, rows of the cluster columns, deepest first:
    cluster_count: (c,) int64, pairs in the cluster, listed or not.
    cluster_deepest: (c,) float64, signed distance of the deepest pair.
    cluster_avatar, cluster_cloud: (c, 3) float64, centres of the deepest pair.
    cluster_scan: (c,) int32, scan of the deepest pair.
    cluster_low, cluster_high: (c, 3) float64, bounding box of the cluster's scan points, world [m].
    """

    verdict: NDArray[np.uint8]
    exact: NDArray[np.bool_]
    pairs_found: NDArray[np.int64]
    pair_starts: NDArray[np.int64]
    avatar_point: Positions
    cloud_point: Positions
    signed_distance: NDArray[np.float64]
    avatar_index: NDArray[np.int32]
    scan_index: NDArray[np.int32]
    cluster: NDArray[np.int32]
    cluster_starts: NDArray[np.int64]
    cluster_count: NDArray[np.int64]
    cluster_deepest: NDArray[np.float64]
    cluster_avatar: Positions
    cluster_cloud: Positions
    cluster_scan: NDArray[np.int32]
    cluster_low: Positions
    cluster_high: Positions
    outside: NDArray[np.bool_]
    voxels_missing: NDArray[np.uint32]
    node_visits: NDArray[np.uint32]
    point_tests: NDArray[np.uint32]

    def __len__(self) -> int:
        """Return the number of poses answered."""
        return len(self.verdict)


class SweepAnswers(Cost, frozen=True, eq=False):
    """Answers of `sweep` for k motions, in their order.

    verdict: (k,) uint8. CONTACT: the first contact lies in [lower, upper]. CLEAR: no contact on the
    whole motion. UNKNOWN: no contact before `lower`, and undecided beyond it, because of grazing, a
    budget or missing data.
    lower, upper: (k,) float64, fractions of the motion, 0 to 1. Nothing touches before `lower`; the
    pose at `upper` is in contact; `upper` is inf if no contact was found. A motion without contact
    has lower 1.
    exact: (k,) bool, whether the motion is clear, or no avatar point moves more than the tolerance
    between `lower` and `upper`.
    witness_avatar, witness_cloud: (k, 3) float64, centres of a pair in contact at `upper`, world
    [m]; NaN if there is none. At `upper` 0, the pair with the least scan point (x, y, z), then the
    least avatar centre; with a tolerance above 1e-6 or a budget, perhaps another one.
    steps: (k,) uint32, number of steps of conservative advancement.
    outside, voxels_missing, node_visits, point_tests: as in `CollideAnswers`.
    """

    verdict: NDArray[np.uint8]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    exact: NDArray[np.bool_]
    witness_avatar: Positions
    witness_cloud: Positions
    steps: NDArray[np.uint32]
    outside: NDArray[np.bool_]
    voxels_missing: NDArray[np.uint32]
    node_visits: NDArray[np.uint32]
    point_tests: NDArray[np.uint32]

    def __len__(self) -> int:
        """Return the number of motions answered."""
        return len(self.verdict)


class RaycastAnswers(Cost, frozen=True, eq=False):
    """Answers of `raycast` for k rays, in their order.

    verdict: (k,) uint8. CONTACT: the ray hits a scan point's sphere within reach. CLEAR: it hits no
    sphere. UNKNOWN: no hit was found, but not everything in reach was examined.
    distance: (k,) float64, along the ray to the first hit [m]; 0 if the ray starts inside a sphere;
    inf if there is no hit.
    lower, upper: (k,) float64, bounds of the true distance [m]; if it is beyond reach, `lower` is
    the reach and `upper` inf.
    exact: (k,) bool, whether `distance` is the true one, or nothing is hit within reach.
    hit: (k, 3) float64, the point where the ray hits, world [m].
    cloud_point: (k, 3) float64, centre of the sphere hit; among several at equal distance, the
    least (x, y, z).
    normal: (k, 3) float64, unit vector from `cloud_point` to `hit`. All three are NaN if there is
    no hit.
    outside, voxels_missing, node_visits, point_tests: as in `CollideAnswers`.
    """

    verdict: NDArray[np.uint8]
    distance: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    exact: NDArray[np.bool_]
    hit: Positions
    cloud_point: Positions
    normal: Positions
    outside: NDArray[np.bool_]
    voxels_missing: NDArray[np.uint32]
    node_visits: NDArray[np.uint32]
    point_tests: NDArray[np.uint32]

    def __len__(self) -> int:
        """Return the number of rays answered."""
        return len(self.verdict)


class WithinAnswers(Cost, frozen=True, eq=False):
    """Answers of `within` for k points, in their order.

    verdict: (k,) uint8. CONTACT: a scan point lies within reach. CLEAR: no scan point does.
    UNKNOWN: none was found, but not everything in reach was examined.
    distance: (k,) float64, to the nearest scan point's centre [m]; inf if none is within reach.
    lower, upper: (k,) float64, bounds of the true distance [m]; if it is beyond reach, `lower` is
    the reach and `upper` inf.
    exact: (k,) bool, whether `distance` is the true one, or nothing is within reach.
    cloud_point: (k, 3) float64, the nearest scan point, world [m]; among several, the least (x, y,
    z); NaN if there is none.
    outside, voxels_missing, node_visits, point_tests: as in `CollideAnswers`.
    """

    verdict: NDArray[np.uint8]
    distance: NDArray[np.float64]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    exact: NDArray[np.bool_]
    cloud_point: Positions
    outside: NDArray[np.bool_]
    voxels_missing: NDArray[np.uint32]
    node_visits: NDArray[np.uint32]
    point_tests: NDArray[np.uint32]

    def __len__(self) -> int:
        """Return the number of points answered."""
        return len(self.verdict)


class ObjectsAnswers(Cost, frozen=True, eq=False):
    """Answer of `objects` for n avatars tested together.

    verdict: (n,) uint8, of each object against the scene; CLEAR if its mask excludes the scene.
    outside, voxels_missing, node_visits, point_tests: (n,), against the scene.
    pairs: (p, 2) int32, rows of objects that touch each other, or that the budget left undecided;
    first < second, in ascending order.
    pair_verdict: (p,) uint8: CONTACT, or UNKNOWN if the budget left the pair undecided.
    pairs_tested: pairs whose trees were compared.  pairs_filtered: pairs excluded by groups and
    masks.
    pair_visits, pair_tests: node visits and point tests of all pairs together.
    """

    verdict: NDArray[np.uint8]
    outside: NDArray[np.bool_]
    voxels_missing: NDArray[np.uint32]
    node_visits: NDArray[np.uint32]
    point_tests: NDArray[np.uint32]
    pairs: IndexPairs
    pair_verdict: NDArray[np.uint8]
    pairs_tested: int = 0
    pairs_filtered: int = 0
    pair_visits: int = 0
    pair_tests: int = 0

    def __len__(self) -> int:
        """Return the number of objects."""
        return len(self.verdict)


class CollidePart(CollideAnswers, frozen=True, eq=False, kw_only=True):
    """Answers of `collide` for poses [first, first + n) of the `total` poses of a path."""

    first: int
    total: int


class DistancePart(DistanceAnswers, frozen=True, eq=False, kw_only=True):
    """Answers of `distance` for poses [first, first + n) of the `total` poses of a path."""

    first: int
    total: int


class ContactsPart(ContactsAnswers, frozen=True, eq=False, kw_only=True):
    """Answers of `contacts` for poses [first, first + n) of the `total` poses of a path."""

    first: int
    total: int


class SweepPart(SweepAnswers, frozen=True, eq=False, kw_only=True):
    """Answers of `sweep` for motions [first, first + n) of the `total` motions of a path."""

    first: int
    total: int


Part = CollidePart | DistancePart | ContactsPart | SweepPart
