"""Checks of the machine: processor, memory, disk, temporary folder, open files, port."""

import os
import platform
import re
import resource
import shutil
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

from ..output.console import bytes_text
from .check import Check, Status, fine

# Instruction sets that kernels use if the processor has them.
_FEATURES = ("sse4_2", "avx", "avx2", "fma", "bmi2", "avx512f", "asimd", "sve")
# With less memory, the defaults of `serve` (--cache 512MB) and `build` (--memory 2GB) may not fit.
_LITTLE_MEMORY = 3 << 30
# With less free space, a small build may fail.
_LITTLE_DISK = 1 << 30
# Most shards of an archive, as in builder/build_limits.py, which needs libraries that may be missing
# here; and files that a process has open besides: libraries, sockets, pipes of workers.
MAX_SHARDS, _OTHER_FILES = 512, 200
_PORT = 7447


def check_cpu() -> Iterator[Check]:
    """Report the processor and the number of cores that this process may use."""
    info = _read(Path("/proc/cpuinfo"))
    model = re.search(r"^model name\s*:\s*(.+)$", info, re.M)
    flags = re.search(r"^(?:flags|Features)\s*:\s*(.+)$", info, re.M)
    words = set(flags[1].split()) if flags else set()
    features = " ".join(name for name in _FEATURES if name in words)
    name = model[1] if model else platform.processor() or platform.machine()
    yield fine("processor", f"{name}{features and ': '}{features}")
    total = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else total
    text = f"{usable} of {total}" if usable < total else f"{total}"
    quota = _read(Path("/sys/fs/cgroup/cpu.max")).split()
    if len(quota) == 2 and quota[0].isdigit() and int(quota[0]) < usable * int(quota[1]):
        share = int(quota[0]) / int(quota[1])
        advice = f"give --jobs {max(1, round(share))} to build, add, remove and validate"
        yield Check("cores", Status.NOTE, f"{text}, limited to the time of {share:.3g}", advice)
    else:
        yield fine("cores", text)


def check_memory() -> Iterator[Check]:
    """Check the memory that is free for this process."""
    found = dict(re.findall(r"^(\w+):\s*(\d+) kB", _read(Path("/proc/meminfo")), re.M))
    if "MemTotal" not in found or "MemAvailable" not in found:
        yield Check("memory", Status.NOTE, "unknown on this system")
        return
    total, free = int(found["MemTotal"]) << 10, int(found["MemAvailable"]) << 10
    text = f"{bytes_text(free)} free of {bytes_text(total)}"
    limit = _read(Path("/sys/fs/cgroup/memory.max")).strip()
    if limit.isdigit() and int(limit) < total:
        used = _read(Path("/sys/fs/cgroup/memory.current")).strip()
        free = min(free, int(limit) - (int(used) if used.isdigit() else 0))
        text = f"{bytes_text(free)} free of {bytes_text(int(limit))}, the limit of this container"
    if free < _LITTLE_MEMORY:
        advice = "give build --memory 512MB and serve --cache 128MB, or close other programs"
        yield Check("memory", Status.WARNING, text, advice)
    else:
        yield fine("memory", text)


def check_disk() -> Iterator[Check]:
    """Check the free space of the working directory's disk."""
    folder = Path.cwd()
    free = shutil.disk_usage(folder).free
    text = f"{bytes_text(free)} free at {folder}"
    if free < _LITTLE_DISK:
        yield Check("disk", Status.WARNING, text, "make room, or give build an -o on another disk")
    elif not os.access(folder, os.W_OK):
        yield Check("disk", Status.NOTE, f"{text}, which you may not write", "give an -o elsewhere")
    else:
        yield fine("disk", text)


def check_temporary_folder() -> Iterator[Check]:
    """Check that there is a folder for temporary files, with space."""
    advice = "set TMPDIR to a folder that you may write, with some free space"
    try:
        folder = Path(tempfile.gettempdir())
        with tempfile.TemporaryFile(dir=folder) as file:
            file.write(b"solidcloud")
        free = shutil.disk_usage(folder).free
    except OSError as error:
        yield Check("temporary folder", Status.FAULT, f"none can be written: {error}", advice)
        return
    text = f"{folder}, {bytes_text(free)} free"
    if free < _LITTLE_DISK:
        yield Check("temporary folder", Status.WARNING, text, advice)
    else:
        yield fine("temporary folder", text)


def check_open_files() -> Iterator[Check]:
    """Check that a process may open all shards of a large archive."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = MAX_SHARDS + _OTHER_FILES
    if soft == resource.RLIM_INFINITY or soft >= needed:
        yield fine("open files", "unlimited" if soft == resource.RLIM_INFINITY else f"up to {soft:,}")
        return
    advice = f"ulimit -n {needed}"
    if hard != resource.RLIM_INFINITY and hard < needed:
        advice = f"the limit of the system is {hard}: ask its administrator for {needed}"
    text = f"up to {soft:,}; a server opens up to {MAX_SHARDS} shards of an archive"
    yield Check("open files", Status.WARNING, text, advice)


def check_port() -> Iterator[Check]:
    """Check that a server can listen on loopback, and report whether its default port is free."""
    try:
        with socket.socket() as probe:
            probe.settimeout(1.0)
            taken = probe.connect_ex(("127.0.0.1", _PORT)) == 0
        with socket.create_server(("127.0.0.1", 0)):
            pass
    except OSError as error:
        advice = "allow connections on 127.0.0.1; build, info and Scene.open work without"
        yield Check("port", Status.FAULT, f"no server can listen: {error}", advice)
        return
    if taken:
        text = f"{_PORT} is in use, perhaps by a server of yours"
        yield Check("port", Status.NOTE, text, "for a second server, give serve --listen another port")
    else:
        yield fine("port", f"{_PORT} is free")


def _read(path: Path) -> str:
    """Return the text of a file of the system, "" if it cannot be read."""
    try:
        return path.read_text(errors="replace")
    except OSError:
        return ""
