"""Test which edits invalidate which kernels."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import solidcloud
from solidcloud.schemas.runtime.kernel_sources import source_digest

CODE = """
import sys, importlib
sys.path.insert(0, sys.argv[1])
from solidcloud.schemas.runtime.kernel_sources import source_digest
print(*[source_digest(name).hex() for name in sys.argv[2:]])
"""
MODULES = [
    "server.kernels.collide.collide_poses",
    "server.kernels.motion.sweep_interval",
    "schemas.kernels.morton",
    "builder.kernels.trees.pack_tree",
]


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """The package's sources in a folder of their own."""
    for room in ("schemas", "builder", "server"):
        source = Path(next(iter(solidcloud.__path__))) / room
        shutil.copytree(source, tmp_path / "solidcloud" / room, ignore=shutil.ignore_patterns("__pycache__"))
    (tmp_path / "solidcloud" / "__init__.py").touch()
    return tmp_path


def digests(copy: Path) -> dict[str, str]:
    names = [f"solidcloud.{module}" for module in MODULES]
    done = subprocess.run(
        [sys.executable, "-P", "-c", CODE, str(copy), *names], capture_output=True, text=True, check=True
    )
    return dict(zip(MODULES, done.stdout.split(), strict=True))


def test_an_edit_invalidates_what_depends_on_it_and_no_more(copy: Path) -> None:
    before = digests(copy)

    def changed(edited: str) -> set[str]:
        path = copy / "solidcloud" / edited
        path.write_text(path.read_text() + "\n# edited\n")
        after = digests(copy)
        found = {module for module in MODULES if after[module] != before[module]}
        before.update(after)
        return found

    assert changed("server/kernels/collide/collide_poses.py") == {"server.kernels.collide.collide_poses"}
    assert changed("server/kernels/core/placed_avatar.py") == {
        "server.kernels.collide.collide_poses",
        "server.kernels.motion.sweep_interval",
    }
    assert changed("schemas/runtime/compiling.py") == set(MODULES)
    assert changed("builder/kernels/trees/pack_tree.py") == {"builder.kernels.trees.pack_tree"}
    # A constant of a module that holds no kernel.
    assert changed("schemas/archive/units.py") == {
        "server.kernels.collide.collide_poses",
        "server.kernels.motion.sweep_interval",
    }
    assert changed("server/scene.py") == set()


def test_the_place_of_the_package_does_not_count(copy: Path) -> None:
    assert digests(copy)["schemas.kernels.morton"] == source_digest("solidcloud.schemas.kernels.morton").hex()
