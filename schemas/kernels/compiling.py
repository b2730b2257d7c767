"""Compilation of kernels, and the cache of compiled code.

Only this module and kernel_dispatcher.py import numba.

numba's own cache unpickles and runs whatever its files contain, does not notice an edit in another
file, and numbers its data files so that two processes may take the same number for two signatures.
Here a file's name is a digest of everything that determines the machine code: the sources, the
signature, the processor, the versions and numba's settings. `schemas/kernels/kernel_files.py` checks its
content.
"""

import functools
import hashlib
import importlib
import pickle
import sys
from collections.abc import Callable
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import config as numba_config
from numba.core import types
from numba.core.caching import _Cache
from numba.core.compiler import CompileResult
from numba.core.serialize import dumps
from numba.experimental import structref
from numba.extending import intrinsic, overload

from .compile_progress import CompileProgress
from .kernel_dispatcher import Kernel, rebuild_inner, reduce_inner
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
    "without_linear_algebra",
]

# numba creates its attributes on import, invisible to type checkers.
config: Any = numba_config

# numba settings that do not affect machine code and differ between processes.
_UNRELATED = frozenset({"CACHE_DIR", "COLOR_SCHEME", "NUMBA_DEFAULT_NUM_THREADS", "NUMBA_NUM_THREADS"})
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
        kernel = Kernel(function, {"nopython": True, "boundscheck": None, **options})
        if cache:
            kernel._cache = _KernelCache(function, inner=False)
            kernel.inner._cache = _KernelCache(function, inner=True)
        return kernel

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


def without_linear_algebra() -> None:
    """Make numba load its array functions without linear algebra, which no kernel uses.

    numba otherwise imports scipy.linalg, if it is installed, before the first kernel: 0.1 s of a
    server's start. Only for a process in which nobody else uses numba.
    """
    if "scipy.linalg" not in sys.modules:
        sys.modules["scipy.linalg"] = None  # type: ignore[assignment]  # an import of it fails
        try:
            importlib.import_module("numba.np.arraymath")
        finally:
            del sys.modules["scipy.linalg"]


def has_compiled() -> bool:
    """Return whether no file held some function, so that this or another process compiles it."""
    return _progress.any or kernel_files().has_waited


@functools.cache
def kernel_files() -> KernelFiles:
    """Return this process's folder of compiled kernels."""
    return KernelFiles(default_folder(config.CACHE_DIR))


class _KernelCache(_Cache):  # type: ignore[misc]
    """Cache of one function's compiled code, with numba's cache interface.

    inner: for calls from other kernels, not from Python.
    """

    def __init__(self, function: Callable[..., Any], *, inner: bool) -> None:
        if function.__closure__ is not None:
            raise TypeError(f"kernel {function.__qualname__}: expected no variables of an enclosing function")
        self._function = function
        self._inner = inner
        self._enabled = True

    @property
    def cache_path(self) -> str:
        """Return the folder, for numba's statistics."""
        return str(kernel_files().folder)

    def load_overload(self, sig: Any, target_context: Any) -> CompileResult | None:
        """Return the compiled code for a signature; None if nothing usable is stored."""
        if not self._enabled:
            return None
        target_context.refresh()
        name = self._name(sig, target_context.codegen())
        payload = kernel_files().read(name)
        if payload is None:
            _progress.begin()
            return None
        try:
            stored, reduced = pickle.loads(payload)
            if stored != sig:
                raise ValueError(f"it is for {stored}, expected {sig}")
            rebuild = rebuild_inner if self._inner else CompileResult._rebuild
            return rebuild(target_context, *reduced)
        except Exception as error:
            kernel_files().discard(name, f"{type(error).__name__}: {error}")
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store the compiled code for a signature."""
        _progress.end()
        if not self._enabled or data.library.has_dynamic_globals or any(not x.can_cache for x in data.lifted):
            return
        reduced = reduce_inner(data) if self._inner else data._reduce()
        kernel_files().write(self._name(sig, data.codegen), dumps((sig, reduced)))

    def enable(self) -> None:
        """Enable the cache."""
        self._enabled = True

    def disable(self) -> None:
        """Disable reading and writing of the cache."""
        self._enabled = False

    def flush(self) -> None:
        """Do nothing: a file with a valid name and digest stays valid."""

    def _name(self, sig: Any, codegen: Any) -> str:
        """Return the file name for a signature and a processor."""
        module, qualname = self._function.__module__, self._function.__qualname__
        decides = (
            self._inner,
            _settings(),
            source_digest(module).hex(),
            module,
            qualname,
            self._function.__code__.co_firstlineno,
            codegen.magic_tuple(),
            sig,
        )
        digest = hashlib.sha256(repr(decides).encode()).hexdigest()
        label = f"{module.partition('.')[2]}.{qualname}"[:_MAX_LABEL] + ".inner" * self._inner
        return label + f"-{digest}.kernel"


@functools.cache
def _settings() -> tuple[Any, ...]:
    """Return versions and numba's settings that affect the machine code."""
    names = [name for name in dir(config) if name.isupper() and name not in _UNRELATED]
    versions = (sys.version, numba.__version__, llvmlite.__version__, np.__version__)
    return (*versions, *((name, repr(getattr(config, name))) for name in names))
