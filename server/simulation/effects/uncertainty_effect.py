"""Effect `uncertainty`: report the probability of contact, for scans with range noise.

It reports in each frame. Contact is with the scan only, not with users or dynamic objects.

The model:
- Each scan s has one error, normally distributed with mean 0 and standard deviation sigma_s [m]. It
  is the same for all points of the scan near the avatar, because they were measured in quick
  succession, at similar ranges and angles. The remaining error there is that of calibration and
  registration, which moves a patch as a whole. (With an independent error for each point, a denser
  scan would make contact more certain, which it does not in reality.)
- The error acts along the separation of the nearest pair of spheres of that scan. The scan is
  touched if g_s + error <= 0, where g_s is its least signed separation [m]. The probability is
  Phi(-g_s / sigma_s). If a scan saw the surface at an angle, its error is along its ray, and
  smaller
  along the separation: the result is then too close to 1/2.
- Scans are independent, so P(contact) = 1 - prod_s Phi(g_s / sigma_s).
- The avatar has no error.

A scan with g_s > MAX_SIGMAS sigma_s is omitted. Each would add less than OMITTED_PROBABILITY =
3.2e-5.

Phi is computed by math.erfc of the C library, which is accurate to a few units in the last place in
both tails, where 1 - Phi would cancel. Its last bits may differ between C libraries; on one machine
the same separations give the same bits. Scans are combined in the order of their numbers.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel_grid import MAX_COORDINATE
from ....schemas.errors import BadRequestError
from ....schemas.scene.effect_table import Uncertainty
from ....schemas.wire.motion_messages import UncertaintyReport
from ....schemas.wire.scene_messages import SceneInfo, SourceInfo
from ...archives.rigid_transform import transform_poses
from ...avatars.avatar_model import make_avatar
from ...queries.distance_per_scan import ANY_SCAN, separation_per_scan
from ...queries.resident_fast_path import distance_fast
from ...queries.scene_data import SceneData
from ..world.frame import Frame
from .report_effects import is_farther_than, nearest

# Number of standard deviations beyond which a scan is omitted.
MAX_SIGMAS = 4.0
_SQRT_2 = math.sqrt(2.0)
# Number of names listed in an error message.
MAX_NAMES_LISTED = 8
# Added to the margin, which is rounded to exact units, so that nothing within four sigma is
# omitted.
EXACT_UNIT = 1.0 / UNITS_PER_METRE

# Names of a source, shortest first: a later one distinguishes sources that an earlier one does not.
_NAMES: tuple[Callable[[SourceInfo], str], ...] = (
    lambda source: PurePath(source.path).name,
    lambda source: source.path,
    lambda source: f"{source.path}:{source.index}",
)


def contact_probability(separation: float, sigma: float) -> float:
    """Return Phi(-separation / sigma), the probability of contact with one scan.

    separation: the scan's least signed separation [m].  sigma: > 0 [m].
    """
    return 0.5 * math.erfc(separation / sigma / _SQRT_2)


# Largest probability that an omitted scan would add.
OMITTED_PROBABILITY = contact_probability(MAX_SIGMAS, 1.0)


def single_probabilities(separations: Mapping[int, float], sigmas: Mapping[int, float]) -> dict[int, float]:
    """Return the probability of contact with each scan alone, by its number, in ascending order.

    Only scans within MAX_SIGMAS of their sigma are included.
    separations: least signed separations [m].  sigmas: [m], of these scans and perhaps others.
    """
    return {
        number: contact_probability(separations[number], sigmas[number])
        for number in sorted(separations)
        if separations[number] <= MAX_SIGMAS * sigmas[number]
    }


def combined_probability(alone: Iterable[float]) -> float:
    """Return the probability of contact with any of several independent scans.

    It is at least that of each scan, and at most 1.
    """
    found = 0.0
    for own in alone:
        found = min(1.0, found + own * (1.0 - found))
    return found


def scan_names(sources: Sequence[SourceInfo]) -> list[str]:
    """Return the name of each source in reports, the first of these that is unique.

    The candidates are the file's name, the path, and the path with the scan's index in the file.
    """
    counts = [Counter(name(source) for source in sources) for name in _NAMES]
    return [
        next(
            (name(s) for name, count in zip(_NAMES, counts, strict=True) if count[name(s)] == 1),
            _NAMES[-1](s),
        )
        for s in sources
    ]


def _sigma_of(effect: Uncertainty, source: SourceInfo) -> float | None:
    """Return the standard deviation [m] that `Uncertainty.scans` gives a source, or None.

    If several of its names are listed, the longest decides.
    """
    own = [effect.scans[name(source)] for name in reversed(_NAMES) if name(source) in effect.scans]
    return own[0] if own else None


def check(effect: Uncertainty, *infos: SceneInfo) -> None:
    """Raise BadRequestError if a name in `scans` belongs to no scan.

    infos: of the scene's archives.
    """
    sources = [source for info in infos for source in info.sources if not source.fault]
    names = {name(source) for source in sources for name in _NAMES}
    for name in effect.scans:
        if name not in names:
            listed = sorted({_NAMES[0](source) for source in sources})
            more = f", and {len(listed) - MAX_NAMES_LISTED} more" if len(listed) > MAX_NAMES_LISTED else ""
            raise BadRequestError(
                f"uncertainty: scans: {name!r} is not a scan of {', '.join(info.scene for info in infos)}: expected "
                f"{', '.join(listed[:MAX_NAMES_LISTED])}{more}: `solidcloud info` lists them"
            )


class ArchiveScans(NamedTuple):
    """Scans of one archive.

    sigmas: [m], by row of `SceneInfo.sources`.  names: of each row, in reports.
    single_scan: number of the only scan; ANY_SCAN if the archive has several scans with one sigma
    and does not store the scan of each point; None if it stores the scan of each point.
    """

    sigmas: dict[int, float]
    names: list[str]
    single_scan: int | None


class WorldScans(NamedTuple):
    """Scans of each archive of a world, of these generations."""

    generations: tuple[int, ...]
    scans: list[ArchiveScans]


def scans_of(effect: Uncertainty, info: SceneInfo, keeps_scan: bool) -> ArchiveScans:
    """Return the scans of an archive. keeps_scan: whether it stores the scan of each point."""
    sigmas, live = {ANY_SCAN: effect.sigma}, []
    for number, source in enumerate(info.sources):
        if not source.fault:
            live.append(number)
            own = _sigma_of(effect, source)
            sigmas[number] = effect.sigma if own is None else own
    single_scan = live[0] if len(live) == 1 else None if keeps_scan else ANY_SCAN
    return ArchiveScans(sigmas, scan_names(info.sources), single_scan)


def make(effect: Uncertainty, world: Any) -> "UncertaintyRunner":
    """Create the effect of a scene. Raises BadRequestError as `check` does."""
    with world as seen:
        check(effect, *(each.placed.info() for each in seen))
        for each in seen:
            if each.data.keeps_scan:
                _warm(each.data)
    return UncertaintyRunner(effect, world)


def _warm(data: SceneData) -> None:
    """Compile the kernel now, and not in the first frame in which something is near."""
    nowhere = np.eye(4)
    nowhere[:3, 3] = MAX_COORDINATE / 2
    separation_per_scan(data, make_avatar([[0.0, 0.0, 0.0]], 0.1), nowhere, 0.0, 1)


class UncertaintyRunner:
    """Effect that reports the probability of contact at the frame's pose."""

    name = "uncertainty"

    def __init__(self, effect: Uncertainty, world: Any) -> None:
        """Create the effect. world: provides the scans, which change with a hot reload."""
        self._effect = effect
        self._margin = MAX_SIGMAS * max(effect.sigma, *effect.scans.values(), 0.0)
        self._known = self._scans_of(world)

    def _scans_of(self, world: Any) -> WorldScans:
        """Return the current scans of each archive."""
        with world as seen:
            return WorldScans(
                world.generations(),
                [scans_of(self._effect, each.placed.info(), each.data.keeps_scan) for each in seen],
            )

    def run(self, frame: Frame) -> None:
        """Search, and write the report."""
        frame.reports[self.name] = self._report(frame)

    def _report(self, frame: Frame) -> UncertaintyReport:
        """Return the report; after an incomplete search, its probability is a lower bound."""
        answers = nearest(frame, self._margin)
        if is_farther_than(answers, self._margin):
            return UncertaintyReport(0.0)
        alone: list[float] = []
        named: dict[str, float] = {}
        exact = True
        with frame.world as seen:
            known = self._known
            if known.generations != frame.world.generations():
                known = self._known = self._scans_of(frame.world)
            for archive, (each, scans) in enumerate(zip(seen, known.scans, strict=True)):
                if scans.single_scan is not None and len(known.scans) == 1 and answers is not None:
                    # The nearest pair of all belongs to the only scan.
                    separations, all_seen = (
                        {scans.single_scan: float(answers.signed_distance[0])},
                        bool(answers.exact[0]),
                    )
                else:
                    separations, all_seen = self._separations(frame, each, scans)
                exact &= all_seen
                for number, own in single_probabilities(separations, scans.sigmas).items():
                    alone.append(own)
                    if number != ANY_SCAN:
                        name = scans.names[number]
                        # One file may be in two archives.
                        named[name if name not in named else f"{name} ({archive})"] = own
        return UncertaintyReport(combined_probability(alone), named, not exact)

    def _separations(self, frame: Frame, each: Any, scans: ArchiveScans) -> tuple[dict[int, float], bool]:
        """Return the least signed separation [m] of each scan of an archive within the margin.

        Also returns whether the search was complete.
        """
        inverse, avatar, margin = each.placed.inverse, frame.body.avatar, self._margin + EXACT_UNIT
        pose = frame.pose if inverse is None else transform_poses(inverse, frame.pose[None])[0]
        if scans.single_scan is None:
            found = separation_per_scan(each.data, avatar, pose, margin, len(scans.names), frame.budget)
            frame.world.count(found.node_visits, not found.exact)
            return found.separations, found.exact
        answers = distance_fast(each.data, avatar, pose, margin, frame.budget)
        frame.world.count(int(answers.node_visits[0]), not answers.exact[0])
        separation = float(answers.signed_distance[0])
        return {scans.single_scan: separation} if separation <= margin else {}, bool(answers.exact[0])
