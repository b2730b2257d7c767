"""Check the structure of the product by its sources: rooms, cycles, doors of libraries, names and sizes of files.

A room is a folder of schemas/, builder/ or server/; a module at the top of one of these is a room of its own.
"""

import ast
import re
import sys
from collections import defaultdict
from pathlib import Path

import pytest
from source_imports import API, PACKAGES, ROOT, Import, all_imports, cycles, imports_of, sources

# Rooms of the same package that each room may import, lower rooms first; every entry is in use. "kernels" stands for
# all its sub-rooms, except between these. Every room may import schemas.
ALLOWED = {
    "schemas/runtime": "errors.py",
    "schemas/kernels": "runtime",
    "schemas/archive": "errors.py kernels runtime",
    "schemas/wire": "archive errors.py",
    "schemas/scene": "archive errors.py runtime wire",
    "builder/kernels/neighbours": "kernels/points",
    "builder/build_limits.py": "config.py",
    "builder/run": "build_limits.py",
    "builder/sources/formats": "kernels sources/common",
    "builder/sources": "sources/common run sources/formats",
    "builder/spool": "config.py kernels",
    "builder/resume": "build_limits.py config.py sources/common run sources spool",
    "builder/voxel": "build_limits.py config.py kernels spool",
    "builder/export": "run voxel",
    "builder/passes": "build_limits.py config.py kernels sources/common run sources spool resume voxel",
    "builder/pipeline.py": "build_limits.py config.py run sources spool resume passes",
    "builder/edit": (
        "build_limits.py config.py kernels sources/common run sources spool resume voxel passes"
    ),
    "builder/plan": (
        "build_limits.py config.py kernels synthetic sources/common run sources spool voxel passes pipeline.py"
    ),
    "server/kernels/collide": "kernels/core",
    "server/kernels/rays": "kernels/core",
    "server/scene_interface.py": "runtime",
    "server/kernels/contacts": "kernels/core",
    "server/kernels/motion": "kernels/core",
    "server/kernels/nearest": "kernels/core",
    "server/kernels/bodies": "kernels/core kernels/motion",
    "server/kernels/walk": "kernels/core kernels/bodies kernels/collide kernels/motion kernels/rays",
    "server/zenoh_common": "scene_interface.py",
    "server/zenoh_client": "runtime zenoh_common scene_interface.py",
    "server/zenoh_server": "observability runtime scene_interface.py zenoh_common",
    "server/avatars": "kernels scene_interface.py",
    "server/client.py": "scene_interface.py zenoh_common zenoh_client avatars",
    "server/residency": "kernels runtime",
    "server/cli/output": "residency",
    "server/queries": "kernels runtime avatars residency",
    "server/archives": "kernels observability runtime avatars residency queries",
    "server/tiles": "residency archives",
    "server/simulation/world": "kernels runtime scene_interface.py avatars queries archives",
    "server/simulation/effects": "queries archives avatars simulation/world",
    "server/simulation": "runtime scene_interface.py avatars queries archives simulation/world",
    "server/open_scene_file.py": "kernels avatars residency archives simulation/effects",
    "server/pictures": "avatars archives",
    "server/scene.py": (
        "observability runtime scene_interface.py avatars residency queries archives simulation open_scene_file.py "
        "pictures tiles"
    ),
    "server/report/common": "cli/input cli/output avatars residency scene.py",
    "server/cli/input": "scene_interface.py",
    "server/cli/scene_files": "scene_interface.py residency archives open_scene_file.py scene.py",
    "server/report/accuracy/measurement": "avatars scene.py report/common",
    "server/report/accuracy/page": "report/common report/accuracy/measurement",
    "server/report/accuracy": "scene.py report/common report/accuracy/measurement report/accuracy/page",
    "server/report/load/users": "cli/input client.py avatars residency report/common",
    "server/report/load/runs": "client.py scene.py report/common report/load/users",
    "server/report/load/page": "report/common report/load/runs report/load/users",
    "server/report/load": "avatars report/common report/load/page report/load/runs report/load/users",
    "server/report/walk": "cli/input client.py cli/output scene.py report/common",
    "server/clash": "scene_interface.py",
    "server/viewer/feeds": "runtime client.py viewer/page zenoh_client",
    "server/viewer/users": (
        "runtime scene_interface.py cli/scene_files viewer/feeds viewer/page zenoh_client"
    ),
    "server/viewer/panels": "cli/input viewer/feeds viewer/page",
    "server/viewer": (
        "runtime scene_interface.py clash client.py viewer/feeds viewer/page viewer/panels viewer/users"
    ),
    "server/cli/doctor": "cli/output scene.py",
    "server/cli/warming": "scene.py",
    "server/cli/commands": (
        "cli/doctor cli/warming cli/input zenoh_common zenoh_server zenoh_client client.py avatars "
        "scene_interface.py cli/output simulation scene.py cli/scene_files report/accuracy/measurement "
        "report/accuracy/page report/accuracy report/common report/load/runs report/load report/walk viewer"
    ),
    "server/cli/commands/archives": "archives cli/commands cli/input cli/output client.py residency",
    "server/cli": "cli/commands cli/commands/archives cli/output",
    "server/api": "client.py scene.py",
}

# From server to builder: an avatar is read, and the points of a record listed, by the builder's code.
CROSSING = {
    "server/pictures": ("builder/voxel/record_points",),
    "server/viewer/users": ("builder/synthetic/figure",),
    "server/tiles": ("builder/voxel/record_points",),
    "server/avatars": (
        "builder/sources/common/scan",
        "builder/sources/placed_scan",
        "builder/sources/scan_files",
        "builder/sources/surface_samples",
    ),
}
# The command line and the reports run builds too.
COMMANDS = ("server/cli", "server/report")

# Library: the files, or the folders with a slash behind, that may import it.
DOORS = {
    "h5py": (
        "schemas/runtime/new_hdf5_file.py",
        "schemas/archive/archive_writer.py",
        "schemas/archive/archive.py",
        "schemas/archive/vtkhdf.py",
    ),
    "zstandard": ("schemas/archive/zstd_frame.py",),
    "zenoh": (
        "server/client.py",
        "server/zenoh_client/",
        "server/zenoh_common/",
        "server/zenoh_server/",
        "server/report/load/users/",
    ),
    "numba": ("schemas/runtime/compiling.py", "schemas/runtime/kernel_dispatcher.py"),
    "llvmlite": ("schemas/runtime/compiling.py", "schemas/runtime/kernel_dispatcher.py"),
    "laspy": ("builder/synthetic/write.py", "builder/export/las_export.py"),
    "lazrs": ("builder/sources/formats/las.py",),
    "pye57": ("builder/sources/formats/e57.py", "builder/synthetic/write.py"),
    "plyfile": ("builder/sources/formats/ply_header.py",),
    "tomli_w": ("builder/sources/scan_list.py",),
    "trimesh": ("builder/sources/surface_samples.py", "builder/synthetic/"),
    "embreex": ("builder/synthetic/scanner.py",),
    "prometheus_client": ("server/observability/prometheus_export.py",),
    "distributed": ("builder/run/dask_cluster.py",),
    "dask": ("builder/run/dask_cluster.py",),
    "matplotlib": ("server/pictures/", "server/report/"),
    "PIL": ("server/report/",),
    "scipy": ("server/report/accuracy/measurement/",),
    "typer": ("server/cli/main.py", "server/cli/commands/"),
    "websockets": ("server/viewer/page/web_server.py",),
    "rich": ("server/cli/output/", "server/report/"),
}
# Needed everywhere; numpy and msgspec are the language that arrays and messages are written in.
FREE = frozenset({"numpy", "msgspec"}) | sys.stdlib_module_names

MOST_LINES = 700


def room_of(module: str) -> str:
    """Return the room of a module, given as a path without suffix: its folder, or itself at the top of a package."""
    folder, _, name = module.rpartition("/")
    return f"{folder}/{name}.py" if folder in PACKAGES else folder


def allowed_from(room: str) -> set[str]:
    """Return the rooms of its package that a room may import, as ALLOWED names them."""
    package = room.split("/")[0]
    return {f"{package}/{name}" for name in ALLOWED.get(room, "").split()}


def entry_for(room: str, aim: str) -> str:
    """Return how ALLOWED names the imported room `aim` in the row of `room`."""
    kernels = f"{aim.split('/')[0]}/kernels"
    return kernels if aim.startswith(kernels) and not room.startswith(kernels) else aim


def stray(found: Import) -> str | None:
    """Return what is wrong with one import, if anything."""
    file, target, line, typing_only = found
    where = f"{file}:{line}"
    top, aim = file.split("/")[0], target.split("/")[0]
    if target == "solidcloud":
        return f"{where}: imports solidcloud by name; inside the package imports are relative"
    if aim in PACKAGES and (ROOT / target).is_dir():
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
    """Return what is wrong with an import of another module of the package, if anything."""
    aim = target.split("/")[0]
    room, aimed = room_of(file.removesuffix(".py")), room_of(target)
    if PACKAGES.index(aim) > PACKAGES.index(top):
        return f"{where}: {top} imports {target}; imports point down, server to builder to schemas"
    if aim == "builder" and top == "server":
        if room.startswith(COMMANDS) or target in CROSSING.get(room, ()):
            return None
        return f"{where}: imports {target}; of the builder {room} may import {CROSSING.get(room, 'nothing')}"
    if aim == top and room != aimed and entry_for(room, aimed) not in allowed_from(room):
        return f"{where}: {room} imports {aimed}; it may import {ALLOWED.get(room, 'no other room')}"
    return None


def test_imports_follow_the_table_and_each_library_has_one_door() -> None:
    found = all_imports()
    assert len(found) > 100, "the sources were not read"
    assert [fault for each in found if (fault := stray(each))] == []


def test_no_module_and_no_room_is_in_a_cycle() -> None:
    modules, rooms = defaultdict(set), defaultdict(set)
    for found in all_imports():
        module, target = found.file.removesuffix(".py"), found.target
        if target.split("/")[0] in PACKAGES and "/" in target:
            modules[module].add(target)
            if room_of(module) != room_of(target):
                rooms[room_of(module)].add(room_of(target))
    assert cycles(modules) == []
    assert cycles(rooms) == []


def test_every_allowed_import_is_used() -> None:
    used = defaultdict(set)
    for found in all_imports():
        room, aim = room_of(found.file.removesuffix(".py")), room_of(found.target)
        if room != aim and room.split("/")[0] == aim.split("/")[0]:
            used[room].add(entry_for(room, aim))
    assert {
        room: allowed_from(room) - used[room] for room in ALLOWED if allowed_from(room) - used[room]
    } == {}


def test_no_two_files_of_a_package_have_one_name() -> None:
    places = defaultdict(list)
    for path in sources():
        if path.name != "__init__.py":
            file = path.relative_to(ROOT)
            places[file.parts[0], file.name].append(file.as_posix())
    assert [same for same in places.values() if len(same) > 1] == []


def test_no_file_is_long() -> None:
    lines = {
        path.relative_to(ROOT).as_posix(): len(path.read_text(encoding="utf-8").splitlines())
        for path in sources()
    }
    assert {file: count for file, count in lines.items() if count > MOST_LINES} == {}, "split it by subject"


def test_every_room_says_what_it_is_for_and_imports_nothing() -> None:
    for folder in {path.parent for path in sources()}:
        tree = ast.parse((folder / "__init__.py").read_text(encoding="utf-8"))
        assert ast.get_docstring(tree), folder
        assert folder == ROOT / API or len(tree.body) == 1, (
            f"{folder}/__init__.py holds more than a docstring"
        )


def test_every_room_says_what_it_may_import() -> None:
    for room in sorted({room_of(path.relative_to(ROOT).as_posix()) for path in sources()} - {"server/api"}):
        if room.endswith(".py") or room in PACKAGES:
            continue
        package = room.split("/")[0]
        names = {f"{package}/{name}" for name in ALLOWED.get(room, "").split()}
        expected = {name if name.endswith(".py") else name.replace("/", ".") for name in names}
        expected |= {"schemas"} if package != "schemas" else set()
        expected |= {module.rpartition("/")[0].replace("/", ".") for module in CROSSING.get(room, ())}
        expected |= {"builder"} if room.startswith(COMMANDS) else set()
        text = ast.get_docstring(ast.parse((ROOT / room / "__init__.py").read_text(encoding="utf-8"))) or ""
        found = re.search(r"May import (.+?)\.(?:\s|$)", text, re.DOTALL)
        assert found, room
        said = {name for name in re.split(r",\s+", found[1]) if name != "nothing of the package"}
        assert said == expected, room


@pytest.mark.parametrize(
    ("file", "source", "said"),
    [
        ("builder/voxel/voxel_octree.py", "from ...server.scene import Scene", "imports point down"),
        ("schemas/archive/codec.py", "from ...builder.voxel.voxel_octree import x", "imports point down"),
        ("server/scene.py", "from ..builder.pipeline import build_archive", "may import nothing"),
        ("server/scene.py", "from .report.walk.demo_walk import main", "it may import observability"),
        (
            "server/queries/collide.py",
            "from ..zenoh_server.watchdog import RequestJob",
            "it may import kernels",
        ),
        ("server/kernels/core/scene_arrays.py", "from ..rays.hits import STACK", "no other room"),
        ("server/scene.py", "from . import queries", "as a whole"),
        ("server/scene.py", "import h5py", "its door is schemas/runtime/new_hdf5_file.py"),
        ("builder/sources/formats/ply.py", "laspy = reader_library('laspy', path)", "its door is"),
        ("server/scene.py", "import requests", "has no door"),
        (
            "server/scene.py",
            "from solidcloud.schemas.archive.voxel import check_voxel",
            "imports are relative",
        ),
        ("server/scene.py", "def f():\n    import zenoh", "its door is"),
        (
            "server/kernels/collide/collide_poses.py",
            "import numba as nb",
            "its door is schemas/runtime/compiling.py",
        ),
    ],
)
def test_a_stray_import_is_named(file: str, source: str, said: str) -> None:
    faults = [stray(found) for found in imports_of(file, source)]
    assert len(faults) == 1
    assert said in (faults[0] or "nothing")


@pytest.mark.parametrize(
    ("file", "source"),
    [
        ("server/avatars/avatar_shape.py", "from ...builder.sources.placed_scan import METRES"),
        ("server/report/walk/demo_walk.py", "from ....builder.pipeline import build_archive"),
        ("server/cli/main.py", "from ...builder.passes.verify import verify_archive"),
        ("server/kernels/collide/collide_poses.py", "from ....schemas.runtime import compiling as nb"),
        ("server/kernels/collide/collide_poses.py", "from ..core.scene_arrays import LANES"),
        ("builder/pipeline.py", "from ..schemas.wire import key_expressions"),
    ],
)
def test_an_allowed_import_is_not(file: str, source: str) -> None:
    assert [stray(found) for found in imports_of(file, source)] == [None]


def test_a_cycle_is_found() -> None:
    assert cycles({"a": {"b"}, "b": {"c"}, "c": {"a"}}) == [["a", "b", "c", "a"]]
    assert cycles({"a": {"b", "c"}, "b": {"c"}}) == []
