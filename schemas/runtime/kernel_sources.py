"""Digests of this package's sources.

Compiled code is used only with the source from which it was made.
A kernel is compiled together with the functions and constants that its module imports. A digest
therefore covers a module and every module of the package that it imports, directly or through
others. An edit invalidates exactly the kernels that depend on it.
"""

import functools
import hashlib
import re
from pathlib import Path
from typing import NamedTuple

_ROOT = Path(__file__).resolve().parents[2]
_PACKAGE = __name__.split(".")[0]
# A relative import: its dots, its module, its names. The package has no other imports of itself
# (tests/test_layers.py).
_IMPORT = re.compile(rb"^[ \t]*from[ \t]+(\.+)([\w.]*)[ \t]+import[ \t]+(\([^)]*\)|[^\n#]*)", re.MULTILINE)
_NAME = re.compile(rb"\w+")

Parts = tuple[str, ...]

# Modules that control what is cached, and do not affect compiled code.
_APART = frozenset({("schemas", "runtime", "kernel_files"), ("schemas", "runtime", "kernel_sources")})


class _Source(NamedTuple):
    """One source file.

    digest: of its bytes.  imports: the modules of the package that it names.
    """

    digest: bytes
    imports: frozenset[Parts]


def source_digest(module: str) -> bytes:
    """Return the digest of a module of this package and of all modules that it imports.

    module: its name, `solidcloud.…`.
    Raises OSError if a source cannot be read, ValueError for a module of another package.
    """
    package, *parts = module.split(".")
    if package != _PACKAGE:
        raise ValueError(f"module {module}: expected one of {_PACKAGE}")
    return _digest(tuple(parts))


@functools.cache
def _digest(module: Parts) -> bytes:
    """Return the digest over the names and digests of all modules that `module` reaches."""
    whole = hashlib.sha256()
    for parts in sorted(_reached(module)):
        whole.update(".".join(parts).encode() + b"\0" + _read(parts).digest)
    return whole.digest()


def _reached(module: Parts) -> set[Parts]:
    """Return the module itself and every module that it imports, directly or through others."""
    found, waiting = {module}, [module]
    while waiting:
        new = _read(waiting.pop()).imports - found - _APART
        found |= new
        waiting.extend(new)
    return found


@functools.cache
def _read(module: Parts) -> _Source:
    """Read one source file."""
    source = _file(module).read_bytes()
    imports = {
        found
        for dots, name, names in _IMPORT.findall(source)
        for found in _named(module[: len(module) - len(dots)], name.decode(), names)
    }
    return _Source(hashlib.sha256(source).digest(), frozenset(imports))


def _named(base: Parts, name: str, names: bytes) -> list[Parts]:
    """Return the modules that `from BASE.NAME import NAMES` names.

    The list is empty if NAME is not a module of the package.
    """
    target = (*base, *filter(None, name.split(".")))
    if _file(target).is_file():
        return [target]
    members = [(*target, member.decode()) for member in _NAME.findall(names)]
    return [member for member in members if _file(member).is_file()]


def _file(module: Parts) -> Path:
    """Return the path of a module's source, whether it exists or not."""
    return _ROOT.joinpath(*module[:-1], f"{module[-1]}.py") if module else _ROOT / "__init__.py"
