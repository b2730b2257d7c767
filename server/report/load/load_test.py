"""Load test of a real server over zenoh: simulated users, each in a session of its own.

Users send requests 30 times a second on an open loop, whatever the response times. Every verdict
that is not unknown is compared with a scene with everything resident. Sections: start (from the
command to the first right answer), kinds (each kind of user at the first budget), budgets (hit
rate), speeds (stalls), users (round trips beside a bare zenoh echo under the same load, until the
cores are saturated). The page, a CSV and a JSON file are written again after every run.
"""

import platform
import tempfile
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ....builder.run.executor import Progress
from ....builder.synthetic.figure import figure_points
from ....builder.synthetic.truth import SceneTruth, read_truth
from ....schemas.errors import SolidcloudError
from ....schemas.runtime.interrupts import check_interrupt
from ....schemas.runtime.os_errors import check_writable
from ...avatars.avatar_model import make_avatar
from ..common.bench_results import Part, write
from ..common.machine import Clock, cpu_name
from .page.load_page import PageState, write_page
from .page.load_pictures import draw_pictures
from .runs import cache_budgets, load_cases, load_run, load_server, start_time
from .runs.load_cases import ECHO, Case, Ran
from .runs.verdict_check import Judge, wrong
from .users import user_traces
from .users.archive_floor import read_floor
from .users.archive_voxels import Voxels, read_voxels
from .users.own_walks import read_walk, repeat_walks
from .users.user_traces import ADVERSARY, KINDS, WALKS, Ground, Trace

SECTIONS = ("start", "kinds", "budgets", "speeds", "users")
ALL_KINDS = (*KINDS, ADVERSARY)
USUAL_BUDGET, USUAL_BUDGETS = 0.1, (0.03, 0.05, 0.1, 0.2, 0.4)
# Share that holds the whole archive, and what a run takes beside its seconds: processes, warm-up [s].
WHOLE, RUN_SECONDS = 1.1, 6.0
_WARM_STARTS = 10  # measured, with the archive's files in the page cache


@dataclass(frozen=True, kw_only=True)
class LoadOptions:
    """Options of a load test.

    walks: files of poses; empty: made walks.  truth: of a generated town, whose users know its doors.
    avatar: points (n, 3) [m]; None: the generated figure.
    budget, budgets: shares of the decoded bytes; None: the usual ones that the archive allows.
    speeds: [m/s].  crowds: numbers of users of section `users`.
    budget_ms: time budget of each request; None: an answer waits for its voxels.
    record, replay: folders of traces.
    """

    sections: tuple[str, ...] = SECTIONS
    kinds: tuple[str, ...] = ALL_KINDS
    walks: tuple[Path, ...] = ()
    truth: Path | None = None
    avatar: NDArray[np.float64] | None = None
    users: int = 8
    seconds: float = 30.0
    budget: float | None = None
    budgets: tuple[float, ...] | None = None
    speeds: tuple[float, ...] = (0.75, 1.5, 3.0, 5.0, 8.0)
    crowds: tuple[int, ...] = (8, 16, 32, 64, 128)
    policies: tuple[str, ...] = ("lru+prefetch", "lru")
    budget_ms: float | None = None
    processes: int = field(default_factory=load_run.cores)
    seed: int = 2012
    record: Path | None = None
    replay: Path | None = None


@dataclass
class LoadReport:
    """Result of a load test. parts: of its sections.  about: machine, archive, options, runs.

    said: machine and archive in a sentence.
    """

    parts: list[Part]
    about: dict[str, Any]
    said: str

    @property
    def failed(self) -> bool:
        """Return whether an answer was wrong, or a section ended early. Missed targets do not matter."""
        return any(part.error or part.wrong for part in self.parts)


def run_load_test(archive: Path, options: LoadOptions, out: Path, progress: Progress) -> LoadReport:
    """Measure an archive under load and write load.html, load.json and load.csv into `out`.

    Raises BadRequestError for budgets or walks that are not possible, before anything runs.
    """
    with tempfile.TemporaryDirectory(prefix="solidcloud-load-") as scratch:
        test = LoadTest(archive, options, Path(scratch), out, progress)
        try:
            test.run()
        finally:
            test.close()
        return test.report()


class LoadTest:
    """State that all sections share. runs: by section, in order."""

    def __init__(
        self, archive: Path, options: LoadOptions, scratch: Path, out: Path, progress: Progress
    ) -> None:
        """Read the archive and check the options."""
        self.options, self.progress, self.out = options, progress, out
        avatar = figure_points() if options.avatar is None else options.avatar
        self.voxels: Voxels = read_voxels(archive)
        self.setup = load_run.Setup(archive, scratch, avatar, options.processes, options.budget_ms)
        one, said = cache_budgets.checked_shares(
            [USUAL_BUDGET], None if options.budget is None else [options.budget], self.voxels, "--budget"
        )
        self.share = one[0]
        self.shares, also = cache_budgets.checked_shares(
            USUAL_BUDGETS, options.budgets, self.voxels, "--budgets"
        )
        self.walks = [read_walk(path) for path in options.walks]
        self.kinds = (WALKS,) if self.walks else options.kinds
        self.remarks = [line for line in (said, also) if line]
        self.checked = cache_budgets.fits_memory(self.voxels.decoded)
        self.judge = Judge(archive, avatar)
        self.runs: dict[str, list[Ran]] = {section: [] for section in SECTIONS}
        self.parts: list[Part] = []
        self.policies: list[str | None] = list(options.policies) or [None]
        self._strips: dict[int, bytes] = {}
        self._place: SceneTruth | Ground | None = None
        self._begin, self._done, self._left = time.perf_counter(), 0, ""
        self._total = 0
        out.mkdir(parents=True, exist_ok=True)
        check_writable(out)

    def close(self) -> None:
        """Close the scene that judges the answers."""
        self.judge.close()

    def run(self) -> None:
        """Run all sections, and write the results after every run."""
        chosen = [
            name for name in SECTIONS if name in self.options.sections and self._cases(name) is not None
        ]
        costs = [cost for name in chosen for cost in self._costs(name)]
        self._total = len(costs)
        self._write("preparing: the server compiles its kernels once")
        with load_server.serving(
            self.setup.archive, self.budget(self.share), None, self.setup.work / "server.log"
        ):
            pass
        self.progress.start("load", len(costs), "runs", costs)
        for name in chosen:
            self._section(name)
        self.progress.finish()
        self._write("")

    def budget(self, share: float) -> int:
        """Return this share of all decoded bytes, at least the largest voxel."""
        return max(int(self.voxels.decoded * share), int(self.voxels.sizes.max()))

    def place(self) -> SceneTruth | Ground:
        """Return where made users walk: the town of the truth, or the archive's own floor."""
        if self._place is None:
            if self.options.truth is not None:
                self._place = read_truth(self.options.truth)
            else:
                lift = make_avatar(self.setup.avatar).radius + self.voxels.radius
                self._place = read_floor(self.setup.archive, lift)
        return self._place

    def trace(self, case: Case) -> Trace:
        """Return the trace of a case's users.

        For adversaries it holds the times of requests, not their poses.
        """
        options = self.options
        if case.kind == WALKS:
            return repeat_walks(self.walks, case.users, options.seconds)
        if case.section == "kinds" and options.replay:
            return user_traces.load(options.replay / f"{case.kind}.npz")
        kind = "turn" if case.kind == ADVERSARY else case.kind
        return user_traces.traces(kind, self.place(), case.users, options.seconds, options.seed, case.speed)

    def report(self) -> LoadReport:
        """Return the results so far."""
        store, options = self.setup.archive, self.options
        machine = {"cpu": cpu_name(), "cores": load_run.cores(), "python": platform.python_version()}
        points, voxels = self.voxels.points, len(self.voxels.keys)
        about = {
            "machine": machine,
            "archive": {"path": str(store), "points": points, "voxels": voxels, "decoded_bytes": self.voxels.decoded},
            "options": {
                "kinds": list(self.kinds), "users": options.users, "seconds": options.seconds,
                "budget": self.share, "seed": options.seed, "only": list(options.sections),
            },
            "runs": [load_cases.summary(ran) for runs in self.runs.values() for ran in runs],
            "seconds": time.perf_counter() - self._begin,
        }  # fmt: skip
        said = (
            f"{store.resolve().name}: {points:,} points, {voxels:,} voxels, {self.voxels.decoded / 2**20:,.0f} MB "
            f"decoded; {machine['cpu']}, {machine['cores']} cores"
        )
        return LoadReport(self.parts, about, said)

    def _cases(self, section: str) -> list[Case] | None:
        """Return the cases of a section; None for a section that does not apply."""
        options, kinds, shares = self.options, self.kinds, [self.share]
        speeds: tuple[float | None, ...] = (None,)
        if section == "start":
            return []
        if section == "speeds":
            if self.walks:
                return None  # the walks have speeds of their own
            kinds, speeds = ("stroll",), options.speeds
        elif section == "users":
            if not cache_budgets.fits_memory(self.budget(WHOLE)):
                return None
            walk = WALKS if self.walks else "stroll"
            return [
                Case(section, walk, users, WHOLE, side) for users in options.crowds for side in (None, ECHO)
            ]
        elif section == "budgets":
            kinds = tuple(kind for kind in ("stroll", "tour", "teleport", WALKS) if kind in kinds)
            shares = self.shares
        return [
            Case(section, kind, options.users, share, policy, speed)
            for kind in kinds
            for share in shares
            for speed in speeds
            for policy in self.policies
        ]

    def _costs(self, section: str) -> list[float]:
        """Return the expected seconds of each run of a section."""
        if section == "start":
            return [RUN_SECONDS, RUN_SECONDS]
        return [self.options.seconds + RUN_SECONDS] * len(self._cases(section) or [])

    def _section(self, name: str) -> None:
        """Run one section; an error ends this section only."""
        part, begin, first = Part(name), time.perf_counter(), self._done
        if not self.parts:
            part.remarks += self.remarks
            if not self.checked:
                part.missing.append(
                    "the archive does not fit this machine's memory: verdicts are not checked"
                )
        self.parts.append(part)
        clock, noted = Clock(0.0), len(part.missing) + (name == "start")
        try:
            if name == "start":
                self._measure_start(part)
            elif name == "users":
                self._measure_users(part, clock)
            else:
                for case in self._cases(name) or []:
                    self._measure(part, case, clock)
        except (SolidcloudError, ValueError, OSError) as error:
            check_interrupt()
            part.error = f"{type(error).__name__}: {error}"
        failed = len(part.missing) - noted
        if failed > 0 and not part.error:
            part.error = f"{failed} of {len(self._costs(name))} runs failed: {part.missing[-1]}"
        self._advance(first + len(self._costs(name)) - self._done)
        load_cases.add_goals(part, self.runs[name])
        part.seconds = time.perf_counter() - begin

    def _measure(self, part: Part, case: Case, clock: Clock) -> None:
        """Run a case and add its figures; a case that fails is reported and the others still run."""
        self._write(f"{case.section}: {case.name}, {case.side}")
        clock.look_around()
        trace = self.trace(case)
        case = replace(case, users=len(np.unique(trace.user)))  # in a replay, the recorded users
        # Recorded requests of adversaries are replayed as they are.
        adversary = case.kind == ADVERSARY and not (case.section == "kinds" and self.options.replay)
        try:
            outcome = load_run.run(self.setup, trace, self.budget(case.share), case.policy, adversary)
        except load_server.ServerError as error:
            part.missing.append(f"{case.name}, {case.side}: {str(error).splitlines()[-1]}")
            self._advance(1)
            return
        if case.section == "kinds" and self.options.record:
            user_traces.save(self.options.record / f"{case.kind}.npz", outcome.trace)
        faults = len(wrong(outcome.frames, self.judge.verdicts(outcome.trace))) if self.checked else 0
        self._add(part, load_cases.make_ran(case, self.budget(case.share), outcome, faults))
        part.others = clock.busy

    def _add(self, part: Part, ran: Ran) -> None:
        """Add a finished case to the results."""
        load_cases.add_figures(part, ran)
        self.runs[ran.case.section].append(ran)
        self._advance(1)

    def _advance(self, runs: int) -> None:
        """Report finished runs."""
        if runs > 0:
            self._done += runs
            self.progress.advance(runs)

    def _measure_start(self, part: Part) -> None:
        """Measure a start with the archive's files dropped from the page cache, then some with them cached."""
        self._write("start: cold, then warm")
        case = Case("start", WALKS if self.walks else "crowd", 1, self.share, None)
        trace = self.trace(case)
        one = Trace(trace.user[:1], trace.time[:1], trace.pose[:1])
        verdict = int(self.judge.verdicts(one)[0]) if self.checked else None
        spent: dict[bool, list[float]] = {True: [], False: []}
        for cold, count in ((True, 1), (False, _WARM_STARTS)):
            for _ in range(count):
                seconds = start_time.first_answer(
                    self.setup, self.budget(self.share), trace.pose[0], verdict, cold
                )
                if seconds is not None:
                    spent[cold].append(seconds)
            self._advance(1)
        if not spent[True]:
            part.missing.append("cold: this system cannot drop files from its cache")
        load_cases.add_start(part, spent[True], spent[False])

    def _measure_users(self, part: Part, clock: Clock) -> None:
        """Measure increasing numbers of users, and the echo under the same load.

        Everything is in the cache in the end.
        """
        cases = self._cases("users") or []
        sizes = load_run.message_sizes(self.setup, self.trace(replace(cases[0], users=1)), self.budget(WHOLE))
        part.remarks.append(f"a question takes {sizes[0]} bytes, its answer {sizes[1]}")
        for case in cases:
            if case.policy != ECHO:
                self._measure(part, case, clock)
                continue
            self._write(f"users: {case.users}, echo")
            outcome = load_run.run_echo(self.setup, self.trace(case), *sizes)
            self._add(part, load_cases.make_ran(case, 0, outcome, 0))
        for side, users in load_cases.knee(self.runs["users"]).items():
            found = "none of these numbers" if users is None else f"{users} users"
            part.remarks.append(f"{side}: over a hundredth of the frames stalls first with {found}")

    def _write(self, now: str) -> None:
        """Write page, JSON and CSV. now: what runs, "" at the end."""
        report = self.report()
        write(report.parts, load_cases.NOTES, report.about, self.out / "load.json")
        state = PageState(now, self._done, self._total, time.perf_counter() - self._begin)
        pictures = draw_pictures(self.runs, self.voxels, self._strips)
        write_page(report.parts, load_cases.NOTES, pictures, report.said, self.out / "load.html", state)
