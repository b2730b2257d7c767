"""Compilation of a kernel for calls from Python, and for calls from other kernels.

numba compiles every function for both uses at once: for Python with two wrappers and machine code,
for other compiled functions as LLVM code that is linked into them. Most kernels have one of these
uses. `Kernel` compiles for a use when it is first needed. The code for other kernels is neither
optimised as a whole nor translated to machine code: that is done once, in the unit of the kernel
that Python calls. Everything before the first answer of `collide` compiles in 24 s of processor
time instead of 38 (scripts/bench_compile).

This module uses parts of numba that may change with its next version: see pyproject.toml.
"""

from typing import Any

import llvmlite.binding as llvm
import numba.core.compiler
import numba.core.dispatcher
from numba.core.codegen import JITCodeLibrary
from numba.core.registry import CPUDispatcher
from numba.core.types import unliteral

# numba creates their attributes on import, invisible to type checkers.
compiler: Any = numba.core.compiler
dispatcher: Any = numba.core.dispatcher
_Dispatcher: Any = CPUDispatcher

_DEFAULTS: dict[str, Any] = compiler.Flags().values()


def _values(self: Any) -> dict[str, Any]:
    """Return all options of a compilation and their values."""
    return _DEFAULTS | self._values


# The same values as numba's, in a tenth of the time. numba compares them whenever it types an
# operation, 140,000 times before the first answer of `collide`: 5 s of 38.
compiler.Flags.values = _values


class Kernel(_Dispatcher):  # type: ignore[misc]
    """Function that Python calls, and that other kernels call as `inner`.

    function: its source.  options: numba's.
    """

    def __init__(self, function: Any, options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options)
        self._compiler = _KernelCompiler(self)
        self.inner = InnerKernel(function, options)

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return the type of a call from another kernel."""
        return self.inner.get_call_template(args, kws)

    def get_overload(self, sig: Any) -> Any:
        """Return the key of the code that another kernel calls."""
        return self.inner.get_overload(sig)


class InnerKernel(_Dispatcher):  # type: ignore[misc]
    """Function that only other kernels can call."""

    def __init__(self, function: Any, options: dict[str, Any]) -> None:
        super().__init__(function, targetoptions=options)
        self._compiler = _InnerCompiler(self)

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

    def __init__(self, kernel: Any) -> None:
        super().__init__(
            kernel.py_func,
            kernel.targetdescr,
            kernel.targetoptions,
            kernel.locals,
            kernel._compiler.pipeline_class,
        )

    def _compile_core(self, args: Any, return_type: Any) -> Any:
        """Compile one signature."""
        compiled = self._compile(args, return_type, compiler.Flags(), None)
        # numba sets the environment of a function in that function's own machine code; an inner
        # kernel has none.
        for environment in compiled._find_referenced_environments():
            compiled.library.codegen.set_env(environment.env_name, environment)
        return compiled

    def _compile(self, args: Any, return_type: Any, flags: Any, library: Any) -> Any:
        self.targetdescr.options.parse_as_flags(flags, self.targetoptions)
        return compiler.compile_extra(
            self.targetdescr.typing_context,
            self.targetdescr.target_context,
            self.py_func,
            args,
            return_type,
            flags,
            self.locals,
            library,
            self.pipeline_class,
        )


class _InnerCompiler(_KernelCompiler):
    """numba's compiler of a function that kernels call, up to LLVM code."""

    def _compile_core(self, args: Any, return_type: Any) -> Any:
        """Compile one signature."""
        target = self.targetdescr.target_context
        library = _InnerLibrary(target.codegen(), self.py_func.__qualname__)
        flags = compiler.Flags()
        flags.no_cpython_wrapper = flags.no_cfunc_wrapper = flags.no_compile = True
        compiled = self._compile(args, return_type, flags, library)._replace(entry_point=_InnerKey())
        target.insert_user_function(compiled.entry_point, compiled.fndesc, [library])
        return compiled


class _InnerKey:
    """Key of an inner kernel's code in numba's table of functions, where others have machine code."""


class _InnerLibrary(JITCodeLibrary):  # type: ignore[misc]
    """LLVM code of a function and of all that it calls."""

    def finalize(self) -> None:
        """Link the code of the functions that are called."""
        self._raise_if_finalized()
        for library in dict.fromkeys(self._linking_libraries):
            self._reload_init.update(library._reload_init)
            self._final_module.link_in(library._get_module_for_linking(), preserve=True)
        self._finalize_dynamic_globals()
        self._finalized = True


def reduce_inner(compiled: Any) -> tuple[Any, ...]:
    """Return the parts of an inner kernel's code that a file stores."""
    compiled.fndesc.typemap = compiled.fndesc.calltypes = None  # cannot be stored, nobody reads them
    return (
        compiled.library.name,
        compiled.library._get_module_for_linking().as_bitcode(),
        compiled.fndesc,
        compiled.environment,
        compiled.signature,
        compiled.reload_init,
        tuple(compiled._find_referenced_environments()),
    )


def rebuild_inner(
    target: Any,
    name: str,
    code: bytes,
    fndesc: Any,
    environment: Any,
    signature: Any,
    reload_init: Any,
    referenced: Any,
) -> Any:
    """Return an inner kernel's code from the parts that `reduce_inner` returned."""
    for initialise in reload_init:
        initialise()
    library = _InnerLibrary(target.codegen(), name)
    library._final_module = library._shared_module = llvm.parse_bitcode(code)
    library._finalize_dynamic_globals()
    library._finalized = True
    return compiler.CompileResult(
        typing_context=target.typing_context,
        target_context=target,
        entry_point=_InnerKey(),
        typing_error=None,
        type_annotation="",
        signature=signature,
        objectmode=False,
        lifted=(),
        fndesc=fndesc,
        library=library,
        call_helper=None,
        environment=environment,
        metadata=None,
        reload_init=reload_init,
        referenced_envs=referenced,
    )
