"""Who may import whom, read from the sources: imports point down, and each library has one door."""

import ast
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).resolve().parent.parent
PACKAGES = ("schemas", "builder", "server")

# Library: the files, or the folders with a slash behind, that may import it.
DOORS = {
    "h5py": ("schemas/new_file.py", "schemas/shard.py", "schemas/index_file.py", "schemas/vtkhdf.py"),
    "zstandard": ("schemas/frames.py",),
    # Questions and sessions, of either side.
    "zenoh": (
        "server/transport.py",
        "server/client.py",
        "server/session_transport.py",
        "server/zenoh_settings.py",
        "server/state_streams.py",
        "server/state_query.py",
        "server/replies.py",
        "server/client_session.py",
        "server/identity.py",
    ),
    "numba": ("schemas/kernels/compiling.py",),
    "llvmlite": ("schemas/kernels/compiling.py",),
    "laspy": ("builder/made/write.py", "builder/export_las.py"),
    "lazrs": ("builder/sources/las.py",),
    "pye57": ("builder/sources/e57.py", "builder/made/write.py"),
    "plyfile": ("builder/sources/ply.py",),
    "tomli_w": ("builder/scan_list.py",),
    "trimesh": ("builder/sources/surface.py", "builder/made/"),
    "embreex": ("builder/made/scanner.py",),
    "prometheus_client": ("server/prometheus.py",),
    "distributed": ("builder/cluster.py",),
    "dask": ("builder/cluster.py",),
    "matplotlib": ("server/report/",),
    "PIL": ("server/report/",),
    "typer": ("server/cli.py", "server/verbs/"),
    "rich": ("server/console.py", "server/progress.py", "server/top.py", "server/report/"),
}
# Needed everywhere; numpy and msgspec are the language that arrays and messages are written in.
FREE = frozenset({"numpy", "msgspec"}) | sys.stdlib_module_names

# An avatar's tree is built by the code that builds a voxel's, and so is a voxel that a scene leaves points of out of;
# nothing else crosses from builder to server.
CROSSING = ("builder/hierarchy", "builder/radius", "builder/without")
# Above both sides: the command line, and the reports.
ABOVE = ("server/cli.py", "server/console.py", "server/report/", "server/verbs/")


class Import(NamedTuple):
    """One import: the file it stands in, what it names as a path below the root or a library, its line."""

    file: str
    target: str
    line: int
    typing_only: bool


def imports_of(file: str, source: str) -> Iterator[Import]:
    """The imports of one file. Relative ones become paths such as "schemas/errors"."""
    tree = ast.parse(source)
    for_types = {
        id(inner)
        for node in ast.walk(tree)
        if isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING"
        for inner in ast.walk(node)
    }
    folder = Path(file).parent.parts
    for node in ast.walk(tree):
        typing_only = id(node) in for_types
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield Import(file, alias.name.split(".")[0], node.lineno, typing_only)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield Import(file, (node.module or "").split(".")[0], node.lineno, typing_only)
        elif isinstance(node, ast.ImportFrom):
            base = (*folder[: len(folder) - node.level + 1], *filter(None, (node.module or "").split(".")))
            if node.module is None or (ROOT.joinpath(*base)).is_dir():
                for alias in node.names:
                    module = (*base, alias.name)
                    found = module if is_module(module) else base
                    yield Import(file, "/".join(found), node.lineno, typing_only)
            else:
                yield Import(file, "/".join(base), node.lineno, typing_only)
        elif isinstance(node, ast.Call) and is_late_import(node):
            # builder/sources imports a library by name, on first use.
            argument = node.args[0]
            if isinstance(argument, ast.Constant):
                yield Import(file, str(argument.value).split(".")[0], node.lineno, False)


def is_module(parts: tuple[str, ...]) -> bool:
    path = ROOT.joinpath(*parts)
    return path.is_dir() or path.with_suffix(".py").is_file()


def is_late_import(call: ast.Call) -> bool:
    name = call.func.id if isinstance(call.func, ast.Name) else getattr(call.func, "attr", "")
    return bool(call.args) and name in ("reader_library", "import_module", "__import__")


def all_imports() -> list[Import]:
    return [
        found
        for package in PACKAGES
        for path in sorted((ROOT / package).rglob("*.py"))
        for found in imports_of(path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8"))
    ]


def stray(found: Import) -> str | None:
    """What is wrong with one import, if anything."""
    file, target, line, typing_only = found
    where = f"{file}:{line}"
    top = file.split("/")[0]
    aim = target.split("/")[0]
    if target == "solidcloud":
        return f"{where}: imports solidcloud by name; inside the package imports are relative"
    if aim in PACKAGES and "/" not in target:
        return f"{where}: imports {target} as a whole or bare; name a module of it, relatively"
    if aim in PACKAGES:
        return stray_inside(where, file, top, target)
    if target in FREE or typing_only:
        return None
    doors = DOORS.get(target)
    if doors is None:
        return f"{where}: {target} has no door; name one in {Path(__file__).name}, or do without it"
    if not any(file.startswith(door) if door.endswith("/") else file == door for door in doors):
        return f"{where}: imports {target}; its door is {', '.join(doors)}"
    return None


def stray_inside(where: str, file: str, top: str, target: str) -> str | None:
    """What is wrong with an import of another module of the package, if anything."""
    aim = target.split("/")[0]
    if PACKAGES.index(aim) > PACKAGES.index(top):
        return f"{where}: {top} imports {target}; imports point down, server to builder to schemas"
    above = file.startswith(ABOVE)
    if top == "server" and aim == "builder" and not above and not target.startswith(CROSSING):
        return f"{where}: imports {target}; the server uses {', '.join(CROSSING)} alone"
    if target.startswith(ABOVE[2:]) and not above:
        return f"{where}: imports {target}; only the command line and the reports stand that high"
    return None


def test_imports_point_down_and_each_library_has_one_door() -> None:
    found = all_imports()
    assert len(found) > 100, "the sources were not read"
    assert [fault for each in found if (fault := stray(each))] == []


@pytest.mark.parametrize(
    ("file", "source", "said"),
    [
        ("builder/octree.py", "from ..server.scene import Scene", "imports point down"),
        ("schemas/codec.py", "from ..builder.octree import x", "imports point down"),
        ("server/scene.py", "from ..builder.pipeline import build_archive", "alone"),
        ("server/scene.py", "from .report.walk import main", "stand that high"),
        ("server/scene.py", "import h5py", "its door is schemas/new_file.py, schemas/shard.py"),
        ("builder/sources/ply.py", "laspy = reader_library('laspy', path)", "its door is"),
        ("server/scene.py", "import requests", "has no door"),
        ("server/scene.py", "from solidcloud.schemas.voxel import check_voxel", "imports are relative"),
        ("server/scene.py", "def f():\n    import zenoh", "its door is"),
        ("server/kernels/overlap.py", "import numba as nb", "its door is schemas/kernels/compiling.py"),
    ],
)
def test_a_stray_import_is_named(file: str, source: str, said: str) -> None:
    faults = [stray(found) for found in imports_of(file, source)]
    assert len(faults) == 1
    assert said in (faults[0] or "nothing")


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("server/avatar.py", "from ..builder.hierarchy import build"),
        ("server/report/walk.py", "from ...builder.pipeline import build_archive"),
        ("server/cli.py", "from ..builder.verify import verify_archive"),
        ("server/kernels/overlap.py", "from ...schemas.kernels import compiling as nb"),
        ("builder/pipeline.py", "from ..schemas import keys"),
    ],
)
def test_an_allowed_import_is_not(file: str, source: str) -> None:
    assert [stray(found) for found in imports_of(file, source)] == [None]
