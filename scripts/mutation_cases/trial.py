"""One trial: the tests of a kernel file, in a forked process that sees a changed source.

The forking process has imported third-party modules, numpy and pytest among them, and nothing of
solidcloud: a trial takes only the time of its tests. Every module of the child that imports the
kernel file gets the changed one.
"""

import contextlib
import importlib.abc
import importlib.machinery
import importlib.util
import json
import os
import resource
import select
import shutil
import signal
import sys
import time
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("schemas", "builder", "server")
MEMORY = 4 << 30  # maximum address space of a child [bytes]: a changed size may request any amount
# Maximum wall time as a multiple of the CPU time limit: the machine may be busy, or the child may
# wait forever.
SLOWEST = 12

PASSED, FAILED, ERROR, TIME, REFUSED = "passed", "failed", "error", "time", "refused"


class Outcome(NamedTuple):
    """End of a trial.

    kind: PASSED; FAILED, an assertion; ERROR, another exception; TIME; REFUSED, an exception for
    unsuitable types, where the compiler would have refused the source.
    test: the first that failed, or "".
    what: the exception.
    seconds: CPU time of the child.
    """

    kind: str
    test: str
    what: str
    seconds: float


def copy_sources(folder: Path) -> None:
    """Copy package and tests, to isolate trials and working tree from each other."""
    for name in PACKAGES:
        shutil.copytree(
            ROOT / name, folder / "solidcloud" / name, ignore=shutil.ignore_patterns("__pycache__")
        )
    (folder / "solidcloud" / "__init__.py").touch()
    shutil.copytree(ROOT / "tests", folder / "tests", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copyfile(ROOT / "pyproject.toml", folder / "pyproject.toml")


class _Changed(importlib.abc.MetaPathFinder, importlib.abc.SourceLoader):
    """Import finder of one module with a changed source."""

    def __init__(self, name: str, path: str, source: str) -> None:
        self.name, self.path, self.source = name, path, source

    def find_spec(
        self, fullname: str, path: Any, target: Any = None
    ) -> importlib.machinery.ModuleSpec | None:
        if fullname != self.name:
            return None
        return importlib.util.spec_from_file_location(fullname, self.path, loader=self)

    def get_filename(self, fullname: str) -> str:
        return self.path

    def get_data(self, path: str | bytes) -> bytes:
        return self.source.encode()

    def get_code(self, fullname: str) -> CodeType:
        return compile(self.source, self.path, "exec", dont_inherit=True)


class _Watch:
    """Pytest plugin that keeps the first exception of a test or of its collection."""

    def __init__(self) -> None:
        self.first: tuple[str, str, str] | None = None

    def note(self, kind: str, test: str, what: str) -> None:
        if self.first is None:
            self.first = (kind, test, what)

    def pytest_exception_interact(self, node: Any, call: Any, report: Any) -> None:
        error = call.excinfo
        # The exceptions of `xfail` and `skip` are no failures, and this hook does not see them.
        text = f"{error.typename}: {str(error.value).strip().splitlines()[0] if str(error.value).strip() else ''}"
        refused = error.errisinstance(TypeError) or (
            error.errisinstance(IndexError) and "only integers" in str(error.value)
        )
        asserted = error.errisinstance(AssertionError) or error.typename == "Failed"
        self.note(REFUSED if refused else FAILED if asserted else ERROR, node.nodeid, text[:200])


def _child(folder: Path, file: str, source: str, tests: list[str], cpu: int, out: int) -> None:
    """Run the tests and write the outcome; never return."""
    resource.setrlimit(resource.RLIMIT_CPU, (cpu, cpu + 1))
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    silent = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(silent, stream)
    os.chdir(folder)
    sys.path[:0] = [str(folder)]
    name = "solidcloud." + file.removesuffix(".py").replace("/", ".")
    sys.meta_path.insert(0, _Changed(name, str(folder / "solidcloud" / file), source))
    import pytest

    watch = _Watch()
    own = ["-x", "-q", "-p", "no:cacheprovider", "--basetemp", str(scratch(folder, os.getpid()))]
    code = int(pytest.main([*own, *tests], plugins=[watch]))
    kind, test, what = watch.first or (
        PASSED if code == 0 else ERROR,
        "",
        "" if code == 0 else f"pytest {code}",
    )
    if code == 0:
        kind = PASSED
    os.write(out, json.dumps([kind, test, what]).encode())
    os._exit(0)


def scratch(folder: Path, pid: int) -> Path:
    """Return the folder where the tests of a child write."""
    return folder / f"scratch-{pid}"


def begin(folder: Path, file: str, source: str, tests: list[str], cpu: int) -> "Trial":
    """Fork a child that runs `tests` with `file` changed to `source`, for at most `cpu` seconds.

    file: path below the package.
    """
    read, write = os.pipe()
    pid = os.fork()
    if pid == 0:
        try:
            os.setsid()
            os.close(read)
            _child(folder, file, source, tests, cpu, write)
        finally:
            os._exit(1)
    os.close(write)
    return Trial(pid, read, time.monotonic() + cpu * SLOWEST, scratch(folder, pid))


class Trial:
    """Running child."""

    def __init__(self, pid: int, pipe: int, end: float, folder: Path) -> None:
        self.pid, self.pipe, self.end, self.folder, self.text = pid, pipe, end, folder, b""

    def outcome(self, wait: float) -> Outcome | None:
        """Return its outcome; None where it is still running after `wait` seconds."""
        if select.select([self.pipe], [], [], wait)[0]:
            part = os.read(self.pipe, 65536)
            self.text += part
            if part:
                return None
        elif time.monotonic() < self.end:
            return None
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        _, status, used = os.wait4(self.pid, 0)
        os.close(self.pipe)
        shutil.rmtree(self.folder, ignore_errors=True)
        seconds = used.ru_utime + used.ru_stime
        if self.text:
            return Outcome(*json.loads(self.text), seconds)
        # No report: killed at the time limit, or by a fault that ended the process.
        ended = os.WTERMSIG(status) if os.WIFSIGNALED(status) else 0
        late = ended in (signal.SIGXCPU, signal.SIGKILL)
        return Outcome(TIME if late else ERROR, "", f"signal {ended}" if ended else "exit", seconds)
