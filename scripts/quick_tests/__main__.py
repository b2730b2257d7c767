"""Run the tests that a change needs, interpreted and compiled at the same time, within a time limit.

A change is what differs from the last commit, new files included; on a clean checkout, the last
commit. Compiled kernels are kept in .venv/kernels, by the content of their sources.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from mutation_cases.plan import TESTS

from .selection import EVERYTHING, PRODUCT, Selected, select

ROOT = Path(__file__).resolve().parents[2]
GRACE = 5.0  # seconds beyond the limit for the test that is running, and then for the report
# Environment and marker expression of the two processes. What is marked as interpreted is not run compiled too.
MODES = {
    "interpreted": ({"NUMBA_DISABLE_JIT": "1"}, "interpreted and not slow"),
    "compiled": ({}, "not interpreted and not slow"),
}


def main() -> int:
    """Select and run; return 1 where a test failed."""
    parser = argparse.ArgumentParser(prog="scripts/test --quick", description=__doc__)
    parser.add_argument("paths", nargs="*", help="files or folders to take for the change")
    parser.add_argument("--since", metavar="REVISION", help="take what differs from this commit")
    parser.add_argument(
        "--limit", type=float, default=70.0, help="seconds for the tests (default %(default)s)"
    )
    options = parser.parse_args()
    began = time.time()
    changed = files_below(options.paths) if options.paths else changed_files(options.since)
    tests, product = sources("tests"), sources(*PRODUCT)
    selected = select(changed, tests, product, TESTS)
    files = {each.file for each in selected}
    print(f"{len(changed)} files changed, {len(files)} test files selected")
    for line in dict.fromkeys(f"  {each.file}: {each.reason}" for each in selected):
        print(line)
    for path in sorted(set(EVERYTHING) & set(changed)):
        print(f"every test depends on {path}: run scripts/test")
    failed = bool(selected) and run_all(selected, began, options.limit)
    others = [path for path in tests if Path(path).name.startswith("test_") and path not in files]
    print(f"not selected: {len(others)} test files; scripts/test runs all")
    return int(failed)


def run_all(selected: list[Selected], began: float, limit: float) -> bool:
    """Run tests in both modes, and print which ran and which did not; return whether one failed."""
    with tempfile.TemporaryDirectory(prefix="solidcloud-quick-") as folder:
        runs = [Run(mode, Path(folder), selected, began + limit) for mode in MODES]
        for run in runs:
            run.finish()
            print(f"\n== {run.mode}\n{run.output.read_text()}", end="")
    done, failed = sum(run.ended.total() for run in runs), any(run.failed() for run in runs)
    outcome = "FAILED" if failed else "passed" if done else "none ended in time"
    print(f"\nran {done} tests in {time.time() - began:.0f} s: {outcome}")
    left = Counter(test.partition("::")[0] for run in runs for test in run.left())
    if left:
        each = ", ".join(f"{file} ({count})" for file, count in left.items())
        print(f"not run, for the limit of {limit:.0f} s: {left.total()} tests: {each}")
    return failed


class Run:
    """pytest in one mode."""

    def __init__(self, mode: str, folder: Path, selected: list[Selected], end: float) -> None:
        self.mode, self.end = mode, end
        self.record, self.output = folder / f"{mode}.record", folder / f"{mode}.txt"
        own, expression = MODES[mode]
        kernels = os.environ.get("NUMBA_CACHE_DIR", str(ROOT / ".venv" / "kernels"))
        paths = [str(ROOT / "scripts"), *filter(None, [os.environ.get("PYTHONPATH")])]
        environment = os.environ | own | {
            "NUMBA_CACHE_DIR": kernels, "PYTHONPATH": os.pathsep.join(paths),
            "QUICK_TESTS_END": str(end), "QUICK_TESTS_RECORD": str(self.record),
        }  # fmt: skip
        command = [
            sys.executable,
            "-P",
            "-m",
            "pytest",
            "-q",
            "-p",
            "quick_tests.time_limit",
            "-m",
            expression,
        ]
        with self.output.open("w") as output:
            self.process = subprocess.Popen(
                [*command, *(each.test for each in selected)],
                cwd=ROOT, env=environment, stdout=output, stderr=subprocess.STDOUT, start_new_session=True,
            )  # fmt: skip

    def finish(self) -> None:
        """Wait until the process ends, or end it."""
        end, self.stopped = self.end + GRACE, False
        for number in (signal.SIGINT, signal.SIGKILL):  # interrupted, pytest prints what failed
            try:
                self.process.wait(max(0.0, end - time.time()))
                break
            except subprocess.TimeoutExpired:
                os.killpg(self.process.pid, number)
                self.stopped = True
                end = time.time() + GRACE
        self.process.wait()
        lines = self.record.read_text().splitlines() if self.record.is_file() else []
        outcomes = [line.partition(" ")[::2] for line in lines]
        self.collected = [test for outcome, test in outcomes if outcome == "collected"]
        self.ended = Counter(test for outcome, test in outcomes if outcome != "collected")
        self.outcomes = {outcome for outcome, _ in outcomes}

    def failed(self) -> bool:
        """Return whether a test failed, or pytest itself. Code 5: no test was collected."""
        return "failed" in self.outcomes or not (self.stopped or self.process.returncode in (0, 2, 5))

    def left(self) -> list[str]:
        """Return the tests that were not run to their end."""
        return [test for test in self.collected if test not in self.ended]


def git(*arguments: str) -> list[str]:
    """Return the lines that git prints."""
    done = subprocess.run(["git", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    return done.stdout.splitlines()


def changed_files(since: str | None) -> list[str]:
    """Return the files that differ from a commit, by default the last one; of a clean checkout, from the one before."""
    new = git("ls-files", "--others", "--exclude-standard")
    found = git("diff", "--name-only", since or "HEAD")
    return [*found, *new] if since or found or new else git("diff", "--name-only", "HEAD~1")


def sources(*folders: str) -> dict[str, str]:
    """Return the Python files below folders of the repository, with their texts."""
    return {path: (ROOT / path).read_text() for path in files_below([*folders]) if path.endswith(".py")}


def files_below(paths: list[str]) -> list[str]:
    """Return the files below paths of the repository."""
    listed = git("ls-files", "--cached", "--others", "--exclude-standard", "--", *paths)
    return [path for path in listed if (ROOT / path).is_file()]


if __name__ == "__main__":
    sys.exit(main())
