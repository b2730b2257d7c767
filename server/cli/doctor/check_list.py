"""All checks, in the order in which they are printed; the self-test, which takes longest, is last."""

from collections.abc import Callable, Iterator

from .check import Check, Status
from .installation_checks import check_command, check_extras, check_libraries, check_python
from .kernel_cache_check import check_compiler, check_kernel_cache
from .machine_checks import (
    check_cpu,
    check_disk,
    check_memory,
    check_open_files,
    check_port,
    check_temporary_folder,
)
from .self_test_run import check_self_test

CHECKS: tuple[Callable[[], Iterator[Check]], ...] = (
    check_python,
    check_command,
    check_libraries,
    check_extras,
    check_cpu,
    check_memory,
    check_disk,
    check_temporary_folder,
    check_open_files,
    check_port,
    check_compiler,
    check_kernel_cache,
    check_self_test,
)


def all_checks() -> Iterator[Check]:
    """Yield the results of all checks, each when it is known."""
    for check in CHECKS:
        try:
            yield from check()
        except (ImportError, OSError, ValueError) as error:
            name = check.__name__.removeprefix("check_").replace("_", " ")
            yield Check(name, Status.FAULT, f"the check failed: {type(error).__name__}: {error}")
