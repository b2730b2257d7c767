"""Imports of the product, read from its sources, and cycles among them."""

import ast
import functools
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("schemas", "builder", "server")
API = "server/api/"


class Import(NamedTuple):
    """One import: its file, what it names as a path below the root or a library, its line."""

    file: str
    target: str
    line: int
    typing_only: bool


def imports_of(file: str, source: str) -> Iterator[Import]:
    """Yield the imports of one file. Relative ones become paths such as "schemas/errors"."""
    tree = ast.parse(source)
    for_types = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    # server/api is installed as the package itself, which its imports are relative to.
    folder = () if file.startswith(API) else Path(file).parent.parts
    for node in ast.walk(tree):
        typing_only = id(node) in for_types
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(file, alias.name.split(".")[0], node.lineno, typing_only)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield Import(file, (node.module or "").split(".")[0], node.lineno, typing_only)
        elif isinstance(node, ast.ImportFrom):
            base = (*folder[: len(folder) - node.level + 1], *filter(None, (node.module or "").split(".")))
            for alias in node.names:
                module = (*base, alias.name)
                found = module if is_module(module) else base
                yield Import(file, "/".join(found), node.lineno, typing_only)
        elif isinstance(node, ast.Call) and is_late_import(node):
            # builder/sources/formats imports a library by name, on first use.
            argument = node.args[0]
            if isinstance(argument, ast.Constant):
                yield Import(file, str(argument.value).split(".")[0], node.lineno, False)


def is_module(parts: tuple[str, ...]) -> bool:
    path = ROOT.joinpath(*parts)
    return path.is_dir() or path.with_suffix(".py").is_file()


def is_late_import(call: ast.Call) -> bool:
    name = call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")
    return bool(call.args) and name in ("reader_library", "import_module", "__import__")


def sources() -> list[Path]:
    return [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


@functools.cache
def all_imports() -> list[Import]:
    return [
        found
        for path in sources()
        for found in imports_of(path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8"))
    ]


def cycles(graph: Mapping[str, set[str]]) -> list[list[str]]:
    """Return a cycle for each edge that closes one, found depth first."""
    found: list[list[str]] = []
    done: set[str] = set()

    def visit(node: str, path: list[str]) -> None:
        if node in path:
            found.append([*path[path.index(node) :], node])
        elif node not in done:
            for after in sorted(graph.get(node, ())):
                visit(after, [*path, node])
            done.add(node)

    for node in sorted(graph):
        visit(node, [])
    return found
