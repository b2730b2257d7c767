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

A scan with g_s > MAX_SIGMAS sigma_s is omitted. Each would add less than 3.2e-5.

Phi is computed by math.erfc of the C library, which is accurate to a few units in the last place in
both tails, where 1 - Phi would cancel. Its last bits may differ between C libraries; on one machine
the same separations give the same bits. Scans are combined in the order of their numbers.
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.errors import BadRequestError
from ....schemas.scene.effect_table import Uncertainty
from ....schemas.wire.motion_messages import UncertaintyReport
from ....schemas.wire.scene_messages import SceneInfo, SourceInfo
from ...archives.rigid_transform import transform_poses
from ...queries.contacts import ANY_SCAN, separation_per_scan
from ...queries.distance import distance_fast
from ..world.frame import Frame, Run
from .report_effects import is_farther_than

# Number of standard deviations beyond which a scan is omitted.
MAX_SIGMAS = 4.0
_SQRT_2 = math.sqrt(2.0)
# Number of names listed in an error message.
MAX_NAMES_LISTED = 8
# Added to the margin, which is rounded to exact units, so that nothing within four sigma is
# omitted.
EXACT_UNIT = 1.0 / UNITS_PER_METRE


def contact_probability(separation: float, sigma: float) -> float:
    """Return Phi(-separation / sigma), the probability of contact with one scan.

    separation: the scan's least signed separation [m].  sigma: > 0 [m].
    """
    return 0.5 * math.erfc(separation / sigma / _SQRT_2)


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


def _names_of(source: SourceInfo) -> tuple[str, str, str]:
    """Return the names of a source: the file's name, the path, and the path with the scan's index in it.

    A later one distinguishes sources that an earlier one does not.
    """
    return PurePath(source.path).name, source.path, f"{source.path}:{source.index}"


def check(effect: Uncertainty, *infos: SceneInfo) -> None:
    """Raise BadRequestError if a name in `scans` belongs to no scan.

    infos: of the scene's archives.
    """
    names = [_names_of(source) for info in infos for source in info.sources if not source.fault]
    known = {name for each in names for name in each}
    for name in effect.scans:
        if name not in known:
            listed = sorted({file for file, *_ in names})
            more = f", and {len(listed) - MAX_NAMES_LISTED} more" if len(listed) > MAX_NAMES_LISTED else ""
            raise BadRequestError(
                f"uncertainty: scans: {name!r} is not a scan of {', '.join(info.scene for info in infos)}: expected "
                f"{', '.join(listed[:MAX_NAMES_LISTED])}{more}: `solidcloud info` lists them"
            )


class ArchiveScans(NamedTuple):
    """Scans of one archive.

    sigmas: [m], by row of `SceneInfo.sources`, and of ANY_SCAN.  names: of each row, in reports: the
    first one that is unique.
    only: number of the only scan; ANY_SCAN if the archive has several.
    """

    sigmas: dict[int, float]
    names: list[str]
    only: int


def scans_of(effect: Uncertainty, sources: Sequence[SourceInfo]) -> ArchiveScans:
    """Return the scans of an archive. If `scans` has several names of one, the longest decides."""
    names = [_names_of(source) for source in sources]
    counts = Counter(kind_and_name for each in names for kind_and_name in enumerate(each))
    shown = [
        next((name for kind, name in enumerate(each) if counts[kind, name] == 1), each[-1]) for each in names
    ]
    live = [number for number, source in enumerate(sources) if not source.fault]
    sigmas = {ANY_SCAN: effect.sigma} | {
        number: next((effect.scans[n] for n in reversed(names[number]) if n in effect.scans), effect.sigma)
        for number in live
    }
    return ArchiveScans(sigmas, shown, live[0] if len(live) == 1 else ANY_SCAN)


def make(effect: Uncertainty, world: Any) -> Run:
    """Create the effect of a scene."""
    return UncertaintyRunner(effect).run


class UncertaintyRunner:
    """Effect that reports the probability of contact at the frame's pose."""

    def __init__(self, effect: Uncertainty) -> None:
        """Create the effect."""
        self._effect = effect
        self._margin = MAX_SIGMAS * max(effect.sigma, *effect.scans.values(), 0.0) + EXACT_UNIT
        self._known: tuple[tuple[int, ...], list[ArchiveScans]] = (), []  # of each archive of generations

    def run(self, frame: Frame) -> UncertaintyReport:
        """Return the report; after an incomplete search, its probability is a lower bound."""
        if is_farther_than(frame, self._margin):
            return UncertaintyReport(0.0)
        alone: list[float] = []
        named: dict[str, float] = {}
        exact = True
        with frame.world as seen:
            known = self._known
            if known[0] != (generations := frame.world.generations()):
                found = [scans_of(self._effect, each.placed.info().sources) for each in seen]
                known = self._known = generations, found
            for archive, (each, scans) in enumerate(zip(seen, known[1], strict=True)):
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
        inverse, avatar, margin = each.placed.inverse, frame.body.avatar, self._margin
        pose = frame.pose if inverse is None else transform_poses(inverse, frame.pose[None])[0]
        if each.data.keeps_scan:
            found = separation_per_scan(each.data, avatar, pose, margin, len(scans.names), frame.budget)
            frame.world.count(found.node_visits, not found.exact)
            return found.separations, found.exact
        answers = distance_fast(each.data, avatar, pose, margin, frame.budget)
        frame.world.count(int(answers.node_visits[0]), not answers.exact[0])
        separation = float(answers.signed_distance[0])
        return {scans.only: separation} if separation <= margin else {}, bool(answers.exact[0])
