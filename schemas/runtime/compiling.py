"""Compilation of kernels, and the cache of compiled code.

Only this module and kernel_dispatcher.py import numba; that one alone uses what numba does not
document.

numba's own cache unpickles and runs whatever its files contain, does not notice an edit in another
file, and numbers its data files so that two processes may take the same number for two signatures.
Here a file's name is a digest of everything that determines the machine code: the sources, the
signature, the family of processors, the versions and numba's settings. No path and nothing else of
the machine takes part, so that compiled code can be delivered (scripts/build_wheel).
`schemas/runtime/kernel_files.py` checks a file's content.
"""

import functools
import hashlib
import importlib.machinery
import logging
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import types
from numba.experimental import structref
from numba.extending import intrinsic, overload

from .kernel_dispatcher import Kernel, config
from .kernel_files import KernelFiles, default_folder
from .kernel_sources import source_digest

__all__ = [
    "config",
    "entry_point",
    "has_compiled",
    "intrinsic",
    "kernel_files",
    "njit",
    "on_first_compilation",
    "overload",
    "structref",
    "types",
]

# numba's settings that affect machine code; its name for them begins with NUMBA_.
_SETTINGS = (
    "BOUNDSCHECK",
    "DEBUGINFO_DEFAULT",
    "ENABLE_PROFILING",
    "EXTEND_VARIABLE_LIFETIMES",
    "LLVM_REFPRUNE_FLAGS",
    "LLVM_REFPRUNE_PASS",
    "LOOP_VECTORIZE",
    "NRT_STATS",
    "OPT",
    "SLP_VECTORIZE",
    "USING_SVML",
)
# Kernels that the package brings along.
_DELIVERED = Path(__file__).parent / "compiled"
# A file name holds 255 bytes; the digest takes 64.
_MAX_LABEL = 150
# A program that compiles for longer than this is told so [s].
_SILENT = 1.0
log = logging.getLogger(__name__)


def njit(*, cache: bool = False, **options: Any) -> Callable[[Callable[..., Any]], Any]:
    """Return a decorator that compiles a function of a kernels module as numba's `njit` does.

    cache: store compiled code in `kernel_files()`.  options: numba's.
    """

    def decorate(function: Callable[..., Any]) -> Any:
        if config.DISABLE_JIT:
            return function
        if cache and function.__closure__ is not None:
            raise TypeError(f"kernel {function.__qualname__}: expected no variables of an enclosing function")
        return Kernel(function, {"nopython": True, "boundscheck": None, **options}, _store if cache else None)

    return decorate


def entry_point(kernel: Any, *arguments: Any) -> Any:
    """Return the compiled code of a kernel, for arguments of the types of these.

    A call of a kernel finds the types of its arguments, which takes up to half a microsecond each
    (scripts/bench_walk); a call of its code takes them for granted. Each argument must therefore have
    the type, and an array the memory order, of the one given here.
    """
    return kernel if config.DISABLE_JIT else kernel.compile(tuple(map(kernel.typeof_pyval, arguments)))


def on_first_compilation(call: Callable[[], object] | None) -> None:
    """Set what is called once before this process compiles its next function; None for nothing."""
    _store.on_first = call


def has_compiled() -> bool:
    """Return whether no file held some function, so that this or another process compiles it."""
    return _store.begun > 0.0 or kernel_files().has_waited


@functools.cache
def kernel_files() -> KernelFiles:
    """Return this process's folder of compiled kernels."""
    return KernelFiles(default_folder(config.CACHE_DIR), _DELIVERED)


class _KernelStore:
    """The store of compiled code, for kernel_dispatcher.py, which calls it one thread at a time.

    on_first: called once, before a compilation begins.  begun: when the first one began; 0: none has.
    """

    def __init__(self) -> None:
        self.on_first: Callable[[], object] | None = None
        self.begun = 0.0
        self._is_told = False

    def name(self, function: Callable[..., Any], sig: Any, target: tuple[str, ...]) -> str:
        """Return the file name of a function's code for a signature and a family of processors."""
        module, qualname = function.__module__, function.__qualname__
        line = function.__code__.co_firstlineno
        decides = (_settings(), source_digest(module).hex(), module, qualname, line, target, sig)
        digest = hashlib.sha256(repr(decides).encode()).hexdigest()
        label = f"{module.partition('.')[2]}.{qualname}"[:_MAX_LABEL]
        return f"{label}-{digest}.kernel"

    def read(self, name: str) -> bytes | None:
        """Return what is stored; None if it is to be compiled."""
        payload = kernel_files().read(name)
        if payload is None:
            self._begin()
        return payload

    def write(self, name: str, payload: bytes) -> None:
        """Store compiled code."""
        kernel_files().write(name, payload)

    def discard(self, name: str, fault: str) -> None:
        """Remove code that cannot be used."""
        kernel_files().discard(name, fault)

    def _begin(self) -> None:
        """Record that a compilation begins, and log it once unless it is over soon.

        The message is a warning if somebody watches the standard error stream, otherwise information,
        so that a program's output does not change. The commands print lines of their own
        (server/cli/output/compile_notice.py).
        """
        first, self.on_first = self.on_first, None
        if first is not None:
            first()
        now = time.monotonic()
        self.begun = self.begun or now
        if now > self.begun + _SILENT and not self._is_told:
            self._is_told = True
            watched = "ipykernel" in sys.modules or (sys.stderr is not None and sys.stderr.isatty())
            log.log(
                logging.WARNING if watched else logging.INFO,
                "compiling for this computer, which is done once and takes up to a minute",
            )


_store = _KernelStore()


@functools.cache
def _settings() -> tuple[Any, ...]:
    """Return versions and numba's settings that affect the machine code.

    Of Python and numpy, code depends on what their patch releases keep.
    """
    versions = (
        importlib.machinery.EXTENSION_SUFFIXES[0],  # version of Python, system, processor
        numba.__version__,
        llvmlite.__version__,
        np.__version__.rpartition(".")[0],
    )
    return (*versions, *((name, repr(getattr(config, name))) for name in _SETTINGS))
