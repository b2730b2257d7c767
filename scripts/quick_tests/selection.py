"""Selection of the tests that a change needs.

In order of rank: a changed test; checks of the product's files as such; the tests that mirror a
changed file; for a kernel, the tests that scripts/mutation_cases/plan.py names for it; tests that
import a changed module, or name a changed script or document. For a module that has none of these,
the tests of the nearest modules that import it, else those of its folder. Other tests that reach a
module through others are left to the whole suite.
"""

import ast
import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePosixPath
from typing import NamedTuple

PRODUCT = ("schemas", "builder", "server")
# Tests of the product's files as such; they take seconds.
ALWAYS = ("tests/test_layers.py", "tests/test_packaging.py")
# Files on which every test depends.
EVERYTHING = ("pyproject.toml", "tests/conftest.py", "scripts/requirements.txt", "scripts/setup")


class Selected(NamedTuple):
    """One test file, or one test of it (FILE::NAME), with the reason for its selection."""

    test: str
    reason: str

    @property
    def file(self) -> str:
        """Return the file of the test."""
        return self.test.partition("::")[0]


def select(
    changed: Sequence[str],
    tests: Mapping[str, str],
    product: Mapping[str, str],
    planned: Mapping[str, Sequence[str]],
) -> list[Selected]:
    """Return the tests that a change needs, each once, the most relevant first.

    changed: paths in the repository, of files that exist or not.
    tests, product: every .py file of tests/ and of the product, with its text.
    planned: kernel file -> its tests.
    """
    names = {path: set(imported(path, text)) for path, text in tests.items()}
    helpers = {path: names[path] for path in tests if not _is_test(path)}
    ranked: list[list[Selected]] = [[], [], [], []]
    for path in [*changed, *_importers([path for path in changed if path in helpers], helpers)]:
        own = _tests_of(path, tests, names, planned)
        if path.startswith(PRODUCT) and path.endswith(".py") and not any(own):
            own = _tests_through(path, tests, names, product, planned)
        for rank, found in zip(ranked, own, strict=False):
            rank += found
    if any(path.startswith(PRODUCT) for path in changed):
        ranked[0] += (Selected(test, "checks every file") for test in ALWAYS if test in tests)
    first: dict[str, Selected] = {}
    for found in (each for rank in ranked for each in rank):
        first.setdefault(found.test, found)
    # A whole file stands for its single tests, at the rank of the first of them.
    whole = {found.file for found in first.values() if found.test == found.file}
    return list({
        found.file if found.file in whole else found.test:
        first[found.file] if found.file in whole else found
        for found in first.values()
    }.values())  # fmt: skip


def _tests_of(
    path: str,
    tests: Mapping[str, str],
    names: Mapping[str, set[str]],
    planned: Mapping[str, Sequence[str]],
    because: str = "",
) -> list[list[Selected]]:
    """Return the tests of one file, by rank."""
    module = module_name(path)
    ranked: list[list[Selected]] = [[], [], [], []]
    if _is_test(path) and path in tests:
        ranked[0].append(Selected(path, "changed"))
    ranked[2] += (Selected(test, f"planned for {path}{because}") for test in planned.get(path, ()))
    for test in filter(_is_test, tests):
        if _mirrors(test, path):
            ranked[1].append(Selected(test, f"mirrors {path}{because}"))
        if module in names[test]:
            ranked[3].append(Selected(test, f"imports {path}{because}"))
        elif module is None and _names(tests[test], path):
            ranked[3].append(Selected(test, f"names {path}"))
    return ranked


def _tests_through(
    path: str,
    tests: Mapping[str, str],
    names: Mapping[str, set[str]],
    product: Mapping[str, str],
    planned: Mapping[str, Sequence[str]],
) -> list[list[Selected]]:
    """Return the tests of the nearest modules that import a file and have tests, else of its folder, by rank."""
    imports = {name: set(imported(name, text)) for name, text in product.items()}
    seen, near = {path}, [path]
    while near:
        near = [name for name in imports if name not in seen and imports[name] & set(map(module_name, near))]
        seen.update(near)
        found = [_tests_of(name, tests, names, planned, f", which uses {path}") for name in near]
        ranked = [[each for own in found for each in own[rank]] for rank in range(4)]
        if any(ranked):
            return ranked
    folder = f"tests/unit/{PurePosixPath(path).parent}"
    return [
        [],
        [Selected(t, f"lies where {path} does") for t in tests if str(PurePosixPath(t).parent) == folder],
    ]


def imported(path: str, text: str) -> Iterator[str]:
    """Yield the modules that a source imports; of `from A import B` both A and A.B."""
    package = (module_name(path) or "").split(".")
    if PurePosixPath(path).name != "__init__.py":
        package = package[:-1]
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            base = [*base, *filter(None, [node.module])]
            yield ".".join(base)
            yield from (".".join([*base, alias.name]) for alias in node.names)


def module_name(path: str) -> str | None:
    """Return the name under which tests import a file; None for a file that is no module."""
    if not path.endswith(".py"):
        return None
    parts = list(PurePosixPath(path).with_suffix("").parts)
    if parts[0] in PRODUCT:
        parts = ["solidcloud", *(parts[2:] if parts[:2] == ["server", "api"] else parts)]
    elif parts[0] == "scripts":
        parts = parts[1:]
    elif parts[0] == "tests":
        parts = parts[-1:]  # tests/support and tests/end_to_end are on the path
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def _is_test(path: str) -> bool:
    return PurePosixPath(path).name.startswith("test_") and path.endswith(".py")


def _mirrors(test: str, path: str) -> bool:
    """Return whether a test file is that of a product file or a script: test_NAME.py, test_NAME_….py."""
    source = PurePosixPath(path)
    if source.parts[0] not in (*PRODUCT, "scripts") or not _is_test(test):
        return False
    folder, stem = source.parent, source.stem
    if source.parts[0] == "scripts":  # a folder X_cases of scripts is tested as the script X
        folder, stem = PurePosixPath("scripts"), PurePosixPath(source.parts[1]).stem.removesuffix("_cases")
    return str(PurePosixPath(test).parent) == f"tests/unit/{folder}" and bool(
        re.fullmatch(rf"test_{re.escape(stem)}(_\w+)?\.py", PurePosixPath(test).name)
    )


def _names(text: str, path: str) -> bool:
    """Return whether a source names a script, a document or a data file, as a text or in a path."""
    return re.search(rf"""(?<=["'/`]){re.escape(PurePosixPath(path).name)}(?![\w.-])""", text) is not None


def _importers(changed: Sequence[str], names: Mapping[str, set[str]]) -> list[str]:
    """Return the files that import changed ones, directly or through others."""
    found, waiting = set(changed), list(changed)
    while waiting:
        module = module_name(waiting.pop())
        new = [path for path in names if path not in found and module in names[path]]
        found.update(new)
        waiting += new
    return sorted(found.difference(changed))
