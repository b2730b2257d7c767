"""Compilation of kernels, and the cache of compiled code.

Only this module and kernel_dispatcher.py import numba; that one alone uses what numba does not
document.

numba's own cache unpickles and runs whatever its files contain, does not notice an edit in another
file, and numbers its data files so that two processes may take the same number for two signatures.
Here a file's name is a digest of everything that determines the machine code: the sources, the
signature, the family of processors, the versions and numba's settings. No path and nothing else of
the machine takes part, so that compiled code can be delivered (scripts/build_wheel).
`schemas/kernels/kernel_files.py` checks a file's content.
"""

import functools
import hashlib
import importlib.machinery
from collections.abc import Callable
from pathlib import Path
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import types
from numba.experimental import structref
from numba.extending import intrinsic, overload

from .compile_progress import CompileProgress
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
_progress = CompileProgress()


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
    _progress.on_first = call


def has_compiled() -> bool:
    """Return whether no file held some function, so that this or another process compiles it."""
    return _progress.any or kernel_files().has_waited


@functools.cache
def kernel_files() -> KernelFiles:
    """Return this process's folder of compiled kernels."""
    return KernelFiles(default_folder(config.CACHE_DIR), _DELIVERED)


class _KernelStore:
    """The store of compiled code, for kernel_dispatcher.py."""

    def name(self, function: Callable[..., Any], inner: bool, sig: Any, target: tuple[str, ...]) -> str:
        """Return the file name of a function's code for a signature and a family of processors."""
        module, qualname = function.__module__, function.__qualname__
        decides = (
            inner,
            _settings(),
            source_digest(module).hex(),
            module,
            qualname,
            function.__code__.co_firstlineno,
            target,
            sig,
        )
        digest = hashlib.sha256(repr(decides).encode()).hexdigest()
        label = f"{module.partition('.')[2]}.{qualname}"[:_MAX_LABEL] + ".inner" * inner
        return label + f"-{digest}.kernel"

    def read(self, name: str) -> bytes | None:
        """Return what is stored; None if it is to be compiled."""
        payload = kernel_files().read(name)
        if payload is None:
            _progress.begin()
        return payload

    def write(self, name: str, payload: bytes) -> None:
        """Store compiled code."""
        _progress.end()
        kernel_files().write(name, payload)

    def discard(self, name: str, fault: str) -> None:
        """Remove code that cannot be used; an empty fault is not reported."""
        kernel_files().discard(name, fault)


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
