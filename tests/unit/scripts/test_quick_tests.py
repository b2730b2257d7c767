"""Test `scripts/test --quick`: the selection of tests, and its time limit."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from quick_tests.selection import Selected, imported, module_name, select

TESTS = {
    "tests/conftest.py": "import pytest",
    "tests/support/clouds.py": "import numpy",
    "tests/support/cases.py": "from clouds import cloud",
    "tests/test_layers.py": "",
    "tests/unit/server/queries/test_collide.py": "from solidcloud.server.queries.collide import collide",
    "tests/unit/server/queries/test_collide_deep.py": "import cases",
    "tests/unit/server/queries/test_collider.py": "",
    "tests/unit/server/kernels/test_spheres.py": "",
    "tests/unit/server/test_scene.py": "from solidcloud.server.queries import collide, distance",
    "tests/unit/scripts/test_loadtest.py": "load_script('simulate_cache')",
    "tests/end_to_end/test_wire.py": "text = Path('schemas/WIRE.md').read_text()",
}
PRODUCT = {
    "server/scene.py": "from .queries import collide",
    "server/client.py": "from ..schemas.wire import keys",
    "server/queries/collide.py": "from ..kernels import boxes",
    "server/queries/within.py": "from ...schemas.sizes import LARGEST",
    "server/kernels/boxes.py": "from ..kernels.planes import plane",
    "server/kernels/planes.py": "",
}
PLANNED = {
    "server/kernels/spheres.py": [
        "tests/unit/server/queries/test_collide.py::test_a[x]",
        "tests/unit/server/kernels/test_spheres.py::test_b",
    ]
}


def chosen(*changed: str) -> list[str]:
    """Return the selected tests."""
    return [each.test for each in select(changed, TESTS, PRODUCT, PLANNED)]


def test_a_product_file_selects_its_mirrors_then_what_imports_it() -> None:
    assert chosen("server/queries/collide.py") == [
        "tests/test_layers.py",
        "tests/unit/server/queries/test_collide.py",
        "tests/unit/server/queries/test_collide_deep.py",
        "tests/unit/server/test_scene.py",
    ]
    found = select(["server/queries/collide.py"], TESTS, PRODUCT, PLANNED)
    assert found[3] == Selected("tests/unit/server/test_scene.py", "imports server/queries/collide.py")


def test_a_kernel_selects_its_planned_tests() -> None:
    assert chosen("server/kernels/spheres.py") == [
        "tests/test_layers.py",
        "tests/unit/server/kernels/test_spheres.py",
        "tests/unit/server/queries/test_collide.py::test_a[x]",
    ]
    both = chosen("server/kernels/spheres.py", "server/queries/collide.py")
    assert "tests/unit/server/queries/test_collide.py" in both and not any(
        "::test_a" in test for test in both
    )


def test_a_module_without_tests_selects_those_of_the_modules_that_use_it() -> None:
    found = select(["server/kernels/planes.py"], TESTS, PRODUCT, PLANNED)
    assert found[1] == Selected(
        "tests/unit/server/queries/test_collide.py",
        "mirrors server/queries/collide.py, which uses server/kernels/planes.py",
    )
    assert chosen("server/kernels/planes.py") == chosen("server/queries/collide.py")
    assert chosen("server/client.py") == ["tests/test_layers.py", "tests/unit/server/test_scene.py"]
    assert chosen("server/network/keys.py") == ["tests/test_layers.py"]


def test_a_changed_test_comes_first_and_a_helper_selects_its_users() -> None:
    assert chosen("tests/unit/server/test_scene.py", "tests/support/clouds.py") == [
        "tests/unit/server/test_scene.py",
        "tests/unit/server/queries/test_collide_deep.py",
    ]
    assert chosen("tests/unit/server/test_gone.py") == []


def test_scripts_and_documents_select_the_tests_that_name_them() -> None:
    assert chosen("schemas/WIRE.md") == ["tests/test_layers.py", "tests/end_to_end/test_wire.py"]
    assert chosen("scripts/simulate_cache") == ["tests/unit/scripts/test_loadtest.py"]
    assert chosen("scripts/loadtest_cases/town_archive.py") == ["tests/unit/scripts/test_loadtest.py"]
    assert chosen("CHANGELOG.md") == []


@pytest.mark.parametrize(
    ("path", "module"),
    [
        ("server/queries/collide.py", "solidcloud.server.queries.collide"),
        ("server/queries/__init__.py", "solidcloud.server.queries"),
        ("server/api/__init__.py", "solidcloud"),
        ("scripts/loadtest_cases/town_archive.py", "loadtest_cases.town_archive"),
        ("tests/support/clouds.py", "clouds"),
        ("scripts/setup", None),
    ],
)
def test_a_file_is_imported_by_its_module_name(path: str, module: str | None) -> None:
    assert module_name(path) == module


def test_names_of_modules_are_those_a_source_imports() -> None:
    text = "import a.b as c\nfrom d import e\ndef f():\n    from g.h import i as j"
    assert set(imported("tests/test_a.py", text)) == {"a.b", "d", "d.e", "g.h", "g.h.i"}
    text = "from . import a\nfrom ..b import c"
    own = {f"solidcloud.server.{name}" for name in ("queries", "queries.a", "b", "b.c")}
    assert set(imported("server/queries/collide.py", text)) == own
    assert set(imported("server/queries/__init__.py", text)) == own


def test_at_the_time_limit_no_further_test_begins(tmp_path: Path) -> None:
    (tmp_path / "test_a.py").write_text("def test_one(): pass\ndef test_two(): pass\n")
    (tmp_path / "pytest.ini").write_text("[pytest]\n")  # no file of the folders above is read
    record = tmp_path / "record"
    environment = os.environ | {
        "PYTHONPATH": str(Path(__file__).parents[3] / "scripts"),
        "QUICK_TESTS_END": "0",
        "QUICK_TESTS_RECORD": str(record),
    }
    command = [sys.executable, "-P", "-m", "pytest", "-q", "-p", "quick_tests.time_limit", "test_a.py"]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 2 and "time limit" in done.stdout, done.stdout + done.stderr
    assert record.read_text().splitlines() == [
        "collected test_a.py::test_one", "collected test_a.py::test_two", "passed test_a.py::test_one",
    ]  # fmt: skip
