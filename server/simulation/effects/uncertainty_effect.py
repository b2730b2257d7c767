"""Effect `uncertainty`: report the probability of contact, for scans with range noise.

server/simulation/world/contact_probability.py states the assumptions. It reports each frame, on
the scene as scanned; users and dynamic objects are not included.
"""

from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import PurePath
from typing import Any, NamedTuple

import numpy as np

from ....schemas.archive.units import UNITS_PER_METRE
from ....schemas.archive.voxel_grid import MAX_COORDINATE
from ....schemas.errors import BadRequestError
from ....schemas.scene.effect_options import Uncertainty
from ....schemas.wire.messages import SceneInfo, SourceInfo
from ....schemas.wire.motion_messages import UncertaintyReport
from ...archives.rigid_transform import under
from ...avatars.avatar_model import make_avatar
from ...queries.context.query_context import SceneData
from ...queries.distance_per_scan import ANY_SCAN, separation_per_scan
from ...queries.resident_fast_path import distance_fast
from ..world.contact_probability import FARTHEST, each_alone, together
from ..world.frame import Frame
from .separation_cache import nearest, surely_farther

# Number of names listed in an error message.
TOLD = 8
# A margin is rounded to exact units: one unit more, so that nothing within four sigma is omitted.
UNIT = 1.0 / UNITS_PER_METRE

# Names of a source, shortest first: a later one distinguishes sources that an earlier one does not.
_NAMES: tuple[Callable[[SourceInfo], str], ...] = (
    lambda source: PurePath(source.path).name,
    lambda source: source.path,
    lambda source: f"{source.path}:{source.index}",
)


def scan_names(sources: Sequence[SourceInfo]) -> list[str]:
    """Return the name of each source in reports.

    It is the file's name; where others share it, the path; for one scan of several in a file, the
    path with its index.
    """
    counts = [Counter(name(source) for source in sources) for name in _NAMES]
    return [
        next(
            (name(s) for name, count in zip(_NAMES, counts, strict=True) if count[name(s)] == 1),
            _NAMES[-1](s),
        )
        for s in sources
    ]


def _called(effect: Uncertainty, source: SourceInfo) -> float | None:
    """Return the standard deviation [m] that `scans` gives a source, or None.

    The longest of its names decides.
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
            more = f", and {len(listed) - TOLD} more" if len(listed) > TOLD else ""
            raise BadRequestError(
                f"uncertainty: scans: {name!r} is no scan of {', '.join(info.scene for info in infos)}: expected "
                f"{', '.join(listed[:TOLD])}{more}: `solidcloud info` lists them"
            )


class Scans(NamedTuple):
    """Scans of one archive.

    sigmas: [m], by their rows in `SceneInfo.sources`.  names: of each row, in reports.
    one: the number of the only scan; ANY_SCAN where the archive has several and does not store the
    scan of a point, and one sigma holds for all; None where it stores the scan.
    """

    sigmas: dict[int, float]
    names: list[str]
    one: int | None


class Known(NamedTuple):
    """Scans of each archive of a world, of these generations."""

    generations: tuple[int, ...]
    scans: list[Scans]


def scans_of(effect: Uncertainty, info: SceneInfo, keeps_scan: bool) -> Scans:
    """Return the scans of an archive. keeps_scan: whether it stores the scan of each point."""
    sigmas, live = {ANY_SCAN: effect.sigma}, []
    for number, source in enumerate(info.sources):
        if not source.fault:
            live.append(number)
            own = _called(effect, source)
            sigmas[number] = effect.sigma if own is None else own
    one = live[0] if len(live) == 1 else None if keeps_scan else ANY_SCAN
    return Scans(sigmas, scan_names(info.sources), one)


def make(effect: Uncertainty, world: Any) -> "UncertaintyRunner":
    """Create the effect of a scene. Raises BadRequestError as `check` does."""
    with world as seen:
        check(effect, *(each.placed.info() for each in seen))
        for each in seen:
            if each.data.keeps_scan:
                _warm(each.data)
    return UncertaintyRunner(effect, world)


def _warm(data: SceneData) -> None:
    """Compile the kernel before the first request needs it.

    Without this, it would be compiled in the first frame in which something is near.
    """
    nowhere = np.eye(4)
    nowhere[:3, 3] = MAX_COORDINATE / 2
    separation_per_scan(data, make_avatar([[0.0, 0.0, 0.0]], 0.1), nowhere, 0.0, 1)


class UncertaintyRunner:
    """Effect that reports the probability of contact at the frame's pose."""

    name = "uncertainty"

    def __init__(self, effect: Uncertainty, world: Any) -> None:
        """Create the effect. world: provides the scans, which change with a hot reload."""
        self._effect = effect
        self._margin = FARTHEST * max(effect.sigma, *effect.scans.values(), 0.0)
        self._known = self._scans_of(world)

    def _scans_of(self, world: Any) -> Known:
        """Return the current scans of each archive."""
        with world as seen:
            return Known(
                world.generations(),
                [scans_of(self._effect, each.placed.info(), each.data.keeps_scan) for each in seen],
            )

    def run(self, frame: Frame) -> None:
        """Search, and write the report."""
        frame.reports[self.name] = self._report(frame)

    def _report(self, frame: Frame) -> UncertaintyReport:
        """Return the report; after an incomplete search, its probability is a lower bound."""
        answers = nearest(frame, self._margin)
        if surely_farther(answers, self._margin):
            return UncertaintyReport(0.0)
        alone: list[float] = []
        named: dict[str, float] = {}
        exact = True
        with frame.world as seen:
            known = self._known
            if known.generations != frame.world.generations():
                known = self._known = self._scans_of(frame.world)
            for archive, (each, scans) in enumerate(zip(seen, known.scans, strict=True)):
                if scans.one is not None and len(known.scans) == 1 and answers is not None:
                    # The nearest pair of all belongs to the only scan.
                    gaps, all_seen = {scans.one: float(answers.signed_distance[0])}, bool(answers.exact[0])
                else:
                    gaps, all_seen = self._gaps(frame, each, scans)
                exact &= all_seen
                for number, own in each_alone(gaps, scans.sigmas).items():
                    alone.append(own)
                    if number != ANY_SCAN:
                        name = scans.names[number]
                        # One file may be in two archives.
                        named[name if name not in named else f"{name} ({archive})"] = own
        return UncertaintyReport(together(alone), named, not exact)

    def _gaps(self, frame: Frame, each: Any, scans: Scans) -> tuple[dict[int, float], bool]:
        """Return the least signed separation [m] of each scan of an archive within the margin.

        Also returns whether the search was complete.
        """
        inverse, avatar, margin = each.placed.inverse, frame.body.avatar, self._margin + UNIT
        pose = frame.pose if inverse is None else under(inverse, frame.pose[None])[0]
        if scans.one is None:
            found = separation_per_scan(each.data, avatar, pose, margin, len(scans.names), frame.budget)
            frame.world.count(found.node_visits, not found.exact)
            return found.separations, found.exact
        answers = distance_fast(each.data, avatar, pose, margin, frame.budget)
        frame.world.count(int(answers.node_visits[0]), not answers.exact[0])
        gap = float(answers.signed_distance[0])
        return {scans.one: gap} if gap <= margin else {}, bool(answers.exact[0])
