"""`solidcloud doctor`: check this machine and the installation."""

from .command_options import AsJson, interruptible, print_json


def doctor(as_json: AsJson = False) -> int:
    """Check this machine and the installation.

    Prints versions, processor, memory, disk and limits, and runs a self-test: it builds a small
    scan and compares answers with brute force. The self-test takes about 5 s, and a minute more if
    it is the first to compile. Exit code 1: something is wrong; the line below it says what to do.
    """
    from contextlib import nullcontext

    from ..doctor.check import Status
    from ..doctor.check_list import all_checks
    from ..output.compile_notice import compile_notices

    found = []
    with interruptible(), nullcontext() if as_json else compile_notices():
        for check in all_checks():
            found.append(check)
            if not as_json:
                print(f"{check.status:<8} {check.name:<17} {check.text}", flush=True)
                if check.advice:
                    print(f"{'':<27}{check.advice}", flush=True)
    faults = [check.name for check in found if check.status is Status.FAULT]
    if as_json:
        print_json({"ok": not faults, "checks": [check._asdict() for check in found]})
    elif faults:
        print(f"{len(faults)} of {len(found)} checks found a fault: {', '.join(faults)}")
    else:
        warned = sum(check.status is Status.WARNING for check in found)
        print(f"{len(found)} checks, no fault{f', warnings: {warned}' if warned else ''}")
    return int(bool(faults))
