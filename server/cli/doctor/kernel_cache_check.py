"""Check of the folder of compiled kernels: where it is, whether it can be used, what is in it."""

import logging
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from ....schemas.runtime import kernel_files
from ....schemas.runtime.kernel_files import KernelFiles, default_folder
from ..output.console import bytes_text
from .check import Check, Status, fine

_KERNEL = ".kernel"


def cache_folder() -> Path:
    """Return the folder of compiled kernels of this process."""
    return default_folder(os.environ.get("NUMBA_CACHE_DIR", ""))


def count_kernels(folder: Path) -> tuple[int, int]:
    """Return the number of compiled kernels in a folder, and their size [bytes]."""
    try:
        with os.scandir(folder) as entries:
            sizes = [entry.stat().st_size for entry in entries if entry.name.endswith(_KERNEL)]
    except OSError:
        return 0, 0
    return len(sizes), sum(sizes)


def check_compiler() -> Iterator[Check]:
    """Warn if kernels are not compiled at all."""
    if os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("", "0"):
        text = "NUMBA_DISABLE_JIT is set: kernels are interpreted, hundreds of times slower"
        yield Check("compiler", Status.WARNING, text, "unset NUMBA_DISABLE_JIT")


def check_kernel_cache() -> Iterator[Check]:
    """Check that compiled kernels can be written and read again."""
    folder = cache_folder()
    with _logged(kernel_files.log) as messages:
        files = KernelFiles(folder)
        name, payload = f"doctor-{secrets.token_hex(8)}{_KERNEL}", secrets.token_bytes(64)
        files.write(name, payload)
        kept = files.read(name) == payload
        with suppress(OSError):
            (folder / name).unlink()
    if not kept:
        fault = "; ".join(messages) or f"{folder}: what is written there cannot be read again"
        text, _, advice = fault.partition(": set ")
        yield Check("kernel cache", Status.FAULT, text, f"set {advice}" if advice else f"remove {folder}")
        return
    count, size = count_kernels(folder)
    kernels = f"{count} compiled kernels, {bytes_text(size)}" if count else "no kernel compiled yet"
    yield fine("kernel cache", f"{folder}, can be written; {kernels}")


@contextmanager
def _logged(logger: logging.Logger) -> Iterator[list[str]]:
    """Collect the messages of a logger in this block instead of printing them."""
    messages: list[str] = []
    handler = logging.Handler()
    handler.emit = lambda record: messages.append(record.getMessage())  # type: ignore[method-assign]
    before, logger.propagate = logger.propagate, False
    logger.addHandler(handler)
    try:
        yield messages
    finally:
        logger.removeHandler(handler)
        logger.propagate = before
