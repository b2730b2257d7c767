"""Compilation of a kernel for calls from Python, and for calls from other kernels.

numba compiles every function for both uses at once: for Python with two wrappers and machine code,
for other compiled functions as LLVM code that is linked into them. Most kernels have one of these
uses. `Kernel` compiles for a use when it is first needed. The code for other kernels (`inner`) is
neither linked with what it calls nor optimised as a whole nor translated to machine code: that is
done once, in the unit of the kernel that Python calls. Of that unit only machine code is stored;
inner kernels are not stored.

This is the only module that uses parts of numba that are not documented and may change with its next
version: see pyproject.toml. They are:

- `CPUDispatcher`, its attributes `_compiler` and `_cache`, and its methods for calls from compiled
  code (`get_call_template`, `get_overload`, `add_overload`);
- `_FunctionCompiler` and `compile_extra`, which take a library for the result; `CompileResult`;
- `JITCodeLibrary`: `_linking_libraries`, `_final_module`, `_shared_module`, `_reload_init` and the
  steps of `finalize`; numba's object cache, which takes machine code in place of its own;
- `_Cache`, the interface of numba's cache of a function, and `dumps`;
- `PassManager.passes`, from which `_Pipeline` takes some away;
- `Flags.values` and `_values`, and `BaseFunction.get_call_type`, of which faster ones take the place; the
  callbacks of llvmlite's lock, which are removed; the options of functions of numba's own library
  (`jit_registry`);
- `JITCPUCodegen` and its methods that name the processor, for code that another processor of the
  family can run; functions of numba's that a kernel calls are linked as LLVM code.
"""

import contextlib
import functools
import gc
import pickle
import weakref
from collections.abc import Callable, Iterator
from typing import Any, Protocol

import llvmlite.binding as llvm
import numba.core.compiler
import numba.core.dispatcher
from numba.core import config as numba_config
from numba.core.caching import _Cache
from numba.core.codegen import JITCodeLibrary, JITCPUCodegen
from numba.core.registry import CPUDispatcher
from numba.core.runtime.nrt import rtsys
from numba.core.serialize import dumps
from numba.core.target_extension import cpu_target, jit_registry
from numba.core.targetconfig import ConfigStack
from numba.core.typed_passes import NopythonRewrites
from numba.core.types import unliteral
from numba.core.types.functions import BaseFunction
from numba.core.untyped_passes import InlineClosureLikes

# numba creates their attributes on import, invisible to type checkers.
config: Any = numba_config
compiler: Any = numba.core.compiler
dispatcher: Any = numba.core.dispatcher
_Dispatcher: Any = CPUDispatcher
_Function: Any = BaseFunction

# LLVM's names of families of processors, the best first: what a processor has to have, and features
# that differ from the name's. AVX-512 is a family of its own: with x86-64-v3 a Zen 5 takes 1.08 and
# 1.1 times as long as with code for itself alone (`collide`, `distance`). LLVM gives x86-64-v4 vectors
# of 256 bits, because of early processors that slow down with wider ones; with 512 bits a Zen 5 takes
# 0.86 and 0.92 times as long as with 256.
_V3 = ("avx2", "bmi", "bmi2", "cx16", "f16c", "fma", "lzcnt", "movbe", "popcnt", "sahf", "xsave")
_V4 = (*_V3, "avx512bw", "avx512cd", "avx512dq", "avx512f", "avx512vl")
_FAMILIES = {("x86-64-v4", "-prefer-256-bit"): _V4, ("x86-64-v3", ""): _V3}

_SKIPPED = (InlineClosureLikes, NopythonRewrites)
_DEFAULTS: dict[str, Any] = compiler.Flags().values()


def _values(self: Any) -> dict[str, Any]:
    """Return all options of a compilation and their values."""
    return _DEFAULTS | self._values


# The same values as numba's, in a tenth of the time. numba compares them whenever it types an
# operation, 140,000 times before the first answer of `collide`: 5 s of 38.
compiler.Flags.values = _values

_search_call_type = _Function.get_call_type
# Not an attribute of the function's type, which is pickled with code that a user caches.
_found_calls: weakref.WeakKeyDictionary[Any, dict[Any, Any]] = weakref.WeakKeyDictionary()


def _call_type(self: Any, context: Any, args: Any, kws: Any) -> Any:
    """Return the signature of a call of a function of numba's own library.

    numba tries all implementations for each call. Most calls are of a function and of types that were met
    before. The options of the caller take part, because its callees inherit them: a function that somebody
    else compiles with `fastmath` leaves no trace in a kernel.
    """
    flags = ConfigStack.top_or_none()
    if kws or flags is None or not isinstance(args, tuple):  # numba passes lists too
        return _search_call_type(self, context, args, kws)
    found = _found_calls.setdefault(self, {})
    case = context, args, str(flags._values)
    if case not in found:
        sig = _search_call_type(self, context, args, kws)
        found[case] = sig, self._impl_keys[sig.args]
    sig, self._impl_keys[sig.args] = found[case]
    return sig


_Function.get_call_type = _call_type


@contextlib.contextmanager
def _with_rare_searches() -> Iterator[None]:
    """Make Python search for unreachable cycles less often.

    A compilation creates millions of objects and keeps most to its end. The searches took a seventh of
    its time and take a twentieth, the longest 0.2 s, as before. Without any, the one after the largest
    kernel stops all threads for more than a second.
    """
    before = gc.get_threshold()
    if before[0]:  # 0: this process has none
        gc.set_threshold(20_000, 20, 100)
    try:
        yield
    finally:
        gc.set_threshold(*before)


# numba measures the time in LLVM by two events a call, 110,000 before the first answer of `collide`, each
# sent to all functions in work. Nobody reads it.
llvm.ffi.lib._lock._cblist.clear()

# Functions of numba's own library that a kernel calls are compiled without a wrapper for C, which nobody
# calls.
jit_registry[cpu_target] = functools.partial(jit_registry.pop(cpu_target), no_cfunc_wrapper=True)


class _Pipeline(compiler.CompilerBase):  # type: ignore[misc]
    """numba's passes but for those of closures and of array expressions, which no kernel has."""

    def define_pipelines(self) -> list[Any]:
        """Return the only pipeline."""
        pipeline = compiler.DefaultPassBuilder.define_nopython_pipeline(self.state)
        pipeline.passes = [each for each in pipeline.passes if each[0] not in _SKIPPED]
        return [pipeline]


class _Codegen(JITCPUCodegen):  # type: ignore[misc]
    """numba's code generator, for a family of processors instead of the one at hand.

    Compiled code then serves all of them. A user's NUMBA_CPU_NAME and NUMBA_CPU_FEATURES take
    precedence.
    """

    def _get_host_cpu_name(self) -> str:
        family = _family()
        return super()._get_host_cpu_name() if family is None else family[0]

    def _get_host_cpu_features(self) -> str:
        family = _family()
        return super()._get_host_cpu_features() if family is None else family[1]


@functools.cache
def _family() -> tuple[str, str] | None:
    """Return the family's name and features; None for the processor at hand, or for the user's choice."""
    if config.CPU_NAME is not None or config.CPU_FEATURES is not None:
        return None
    machine = llvm.get_process_triple().partition("-")[0]
    if machine in ("aarch64", "arm64"):
        return "generic", ""
    found = llvm.get_host_cpu_features() if machine == "x86_64" else {}
    return next((family for family, needed in _FAMILIES.items() if all(map(found.get, needed))), None)


@functools.cache
def _codegen() -> _Codegen:
    """Return the code generator of kernels; numba's own goes on to compile other functions."""
    return _Codegen("solidcloud")


class Store(Protocol):
    """Place of compiled code; every method takes the name of the code."""

    def name(self, function: Callable[..., Any], sig: Any, target: tuple[str, ...]) -> str:
        """Return the name of a function's code for a signature and a target."""

    def read(self, name: str) -> bytes | None:
        """Return what is stored; None if nothing is."""

    def write(self, name: str, payload: bytes) -> None:
        """Store compiled code."""

    def discard(self, name: str, fault: str) -> None:
        """Remove code that cannot be used."""


class Kernel(_Dispatcher):  # type: ignore[misc]
    """Function that Python calls, and that other kernels call as `inner`.

    function: its source.  options: numba's.  store: where its code is kept; None for nowhere.
    """

    def __init__(self, function: Any, options: dict[str, Any], store: Store | None) -> None:
        super().__init__(function, targetoptions=options, pipeline_class=_Pipeline)
        self._compiler.__class__ = _KernelCompiler
        if store is not None:
            self._cache = _StoredCode(function, store)

    @functools.cached_property
    def inner(self) -> "InnerKernel":
        """Return the function for calls from other kernels."""
        return InnerKernel(self.py_func, self.targetoptions)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return the type of a call from another kernel."""
        return self.inner.get_call_template(args, kws)

    def get_overload(self, sig: Any) -> Any:
        """Return the key of the code that another kernel calls."""
        return self.inner.get_overload(sig)

    def _compilation_chain_init_hook(self) -> None:
        """Do not look for numba's extensions before a call: compilation does, stored code needs none."""


class InnerKernel(_Dispatcher):  # type: ignore[misc]
    """Function that only other kernels can call. Parameters as `Kernel`."""

    def __init__(self, function: Any, options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options, pipeline_class=_Pipeline)
        self._compiler.__class__ = _InnerCompiler

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return the type of a call. A constant is a value like any other.

        numba compiles a function once more for each constant that it is called with.
        """
        return super().get_call_template(
            tuple(map(unliteral, args)), {name: unliteral(value) for name, value in kws.items()}
        )

    def add_overload(self, cres: Any) -> None:
        """Store the code for a signature."""
        self.overloads[tuple(cres.signature.args)] = cres


class _KernelCompiler(dispatcher._FunctionCompiler):  # type: ignore[misc]
    """numba's compiler of a function that Python calls."""

    @_with_rare_searches()
    def _compile_core(self, args: Any, return_type: Any) -> Any:
        """Compile one signature."""
        flags = compiler.Flags()
        flags.no_cfunc_wrapper = True
        compiled = self._compile(args, return_type, flags, _KernelLibrary)
        # numba sets the environment of a function in that function's own machine code; an inner
        # kernel has none.
        for environment in compiled._find_referenced_environments():
            compiled.library.codegen.set_env(environment.env_name, environment)
        return compiled

    def _compile(self, args: Any, return_type: Any, flags: Any, library: Any) -> Any:
        target = self.targetdescr.target_context
        self.targetdescr.options.parse_as_flags(flags, self.targetoptions)
        code = library(_codegen(), self.py_func.__qualname__)
        code.enable_object_caching()
        return compiler.compile_extra(
            self.targetdescr.typing_context,
            target,
            self.py_func,
            args,
            return_type,
            flags,
            self.locals,
            code,
            self.pipeline_class,
        )


class _InnerCompiler(_KernelCompiler):
    """numba's compiler of a function that kernels call, up to LLVM code."""

    def _compile_core(self, args: Any, return_type: Any) -> Any:
        """Compile one signature."""
        flags = compiler.Flags()
        flags.no_cpython_wrapper = flags.no_cfunc_wrapper = flags.no_compile = True
        compiled = self._compile(args, return_type, flags, _InnerLibrary)._replace(entry_point=_InnerKey())
        self.targetdescr.target_context.insert_user_function(
            compiled.entry_point, compiled.fndesc, [compiled.library]
        )
        return compiled


class _InnerKey:
    """Key of an inner kernel's code in numba's table of functions, where others have machine code."""


class _InnerLibrary(JITCodeLibrary):  # type: ignore[misc]
    """LLVM code of a function and of numba's functions that it calls.

    callees: the inner kernels that it calls.
    """

    def __init__(self, codegen: Any, name: str) -> None:
        super().__init__(codegen, name)
        self.callees: list[_InnerLibrary] = []

    def finalize(self) -> None:
        """Link the code of numba's functions that are called."""
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            if isinstance(library, _InnerLibrary):
                self.callees.append(library)
            else:
                self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True

    def own_module(self) -> Any:
        """Return the LLVM code without that of inner kernels."""
        return super()._get_module_for_linking()

    def _get_module_for_linking(self) -> Any:
        """Return the LLVM code with that of inner kernels, for functions that numba compiles."""
        module = self.own_module().clone()
        for library in in_order(self.callees):
            module.link_in(library.own_module(), preserve=True)
        return module


def in_order(libraries: list[_InnerLibrary]) -> list[_InnerLibrary]:
    """Return inner kernels and all that they call, each after everything that calls it.

    The linker takes a function only if something linked before calls it.
    """
    done: dict[_InnerLibrary, None] = {}

    def visit(library: _InnerLibrary) -> None:
        if library not in done:
            for callee in library.callees:
                visit(callee)
            done[library] = None

    for library in libraries:
        visit(library)
    return list(reversed(done))


class _KernelLibrary(JITCodeLibrary):  # type: ignore[misc]
    """Machine code of a function and of all that it calls."""

    def finalize(self) -> None:
        """Link all that is called, once, and compile."""
        libraries = dict.fromkeys(self._linking_libraries)
        inner = in_order([library for library in libraries if isinstance(library, _InnerLibrary)])
        self._linking_libraries = [library for library in libraries if not isinstance(library, _InnerLibrary)]
        for library in inner:
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library.own_module(), preserve=True)
        super().finalize()

    def load(self, code: bytes) -> None:
        """Take stored machine code instead of compiling."""
        self.enable_object_caching()
        self._set_compiled_object(code)
        self._finalize_final_module()

    def get_pointer_to_function(self, name: str) -> int:
        """Return the address of a function that this machine code has."""
        self._ensure_finalized()
        return self._codegen._engine.get_function_address(name)


class _StoredCode(_Cache):  # type: ignore[misc]
    """Stored code of one kernel, with numba's cache interface."""

    cache_path = ""

    def __init__(self, function: Callable[..., Any], store: Store) -> None:
        self._function, self._store = function, store

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the code for a signature; None if nothing usable is stored."""
        name = self._name(sig)
        payload = self._store.read(name)
        if payload is None:
            return None
        try:
            stored, parts = pickle.loads(payload)
            if stored != sig:
                raise ValueError(f"it is for {stored}, expected {sig}")
            return _rebuild(target_context, *parts)
        except Exception as error:
            self._store.discard(name, f"{type(error).__name__}: {error}")
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Store the code for a signature."""
        if data.library.has_dynamic_globals or any(not x.can_cache for x in data.lifted):
            return
        data.fndesc.typemap = data.fndesc.calltypes = None  # cannot be stored, nobody reads them
        environments = tuple(data._find_referenced_environments())
        parts = (
            data.library.name, data.library._get_compiled_object(), data.fndesc, data.environment,
            data.signature, data.reload_init, environments,
        )  # fmt: skip
        self._store.write(self._name(sig), dumps((sig, parts)))

    def _name(self, sig: Any) -> str:
        return self._store.name(self._function, sig, _codegen().magic_tuple())

    def enable(self) -> None:
        """Do nothing: stored code is always used."""

    def disable(self) -> None:
        """Do nothing, as `enable`."""

    def flush(self) -> None:
        """Do nothing: code with a valid name stays valid."""


def _rebuild(
    target: Any, name: str, code: bytes, fndesc: Any, env: Any, sig: Any, reload_init: Any, environments: Any
) -> Any:
    """Return a kernel's code from the parts that `save_overload` stored."""
    rtsys.initialize(target)  # numba's memory management, which the code calls
    for initialise in reload_init:
        initialise()
    library = _KernelLibrary(_codegen(), name)
    library.load(code)
    entry_point = target.get_executable(library, fndesc, env)
    for environment in environments:
        library.codegen.set_env(environment.env_name, environment)
    return compiler.compile_result(
        typing_context=target.typing_context,
        target_context=target,
        entry_point=entry_point,
        type_annotation="",
        signature=sig,
        objectmode=False,
        lifted=(),
        fndesc=fndesc,
        library=library,
        environment=env,
        reload_init=reload_init,
        referenced_envs=environments,
    )
