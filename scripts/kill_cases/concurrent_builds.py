"""Two builders of one target: the second is refused at once, and the first continues undisturbed."""

import signal
import time

from .forked_command import Child
from .random_kills import ReferenceBuild, check_finish
from .stopped_build import Tally

# Maximum time until the second builder is refused [s].
AT_ONCE = 1.0


def rival(reference: ReferenceBuild, tally: Tally) -> float:
    """Stop a builder halfway, let another try, resume the first; return the duration of the second [s]."""
    case = reference.case()
    work = case.folder / ".hall.building"
    first = Child(case.arguments(), case.folder.with_suffix(".first.log"))
    first.go()
    deadline = time.monotonic() + 30
    while not work.exists() and first.wait(0) is None and time.monotonic() < deadline:
        time.sleep(0.001)
    first.signal(signal.SIGSTOP)
    faults = [] if first.wait(0) is None else ["the first builder was done before it could be stopped"]
    second = Child(case.arguments(), case.folder.with_suffix(".second.log"))
    begin = time.perf_counter()
    second.go()
    code = second.end()
    seconds = time.perf_counter() - begin
    if code != 2 or "another build, add or remove is writing it" not in second.said():
        faults.append(f"the second builder exited with {code}: {second.said()[-1000:]}")
    if seconds > AT_ONCE:
        faults.append(f"the second builder was refused after {seconds:.2f} s, expected at most {AT_ONCE}")
    first.signal(signal.SIGCONT)
    if first.end() != 0:
        faults.append(f"the first builder exited with {first.status}: {first.said()[-1000:]}")
    tally.add("two builders", faults + case.finished())

    # A lock ends with its holder: a builder that starts after a kill is not refused.
    case = reference.case()
    first = Child(case.arguments(), case.folder.with_suffix(".first.log"))
    first.go()
    first.wait(reference.seconds / 2)
    first.signal(signal.SIGKILL)
    first.end()
    check_finish(case, tally, "a builder after a killed one")
    return seconds
