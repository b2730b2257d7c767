"""Test that the wheel holds every module and data file, and that the pins cover every extra."""

import json
import re
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from project_scripts import load_script

ROOT = Path(__file__).resolve().parent.parent
DISTRIBUTION = metadata.distribution("solidcloud")


def is_wheel() -> bool:
    origin = json.loads(DISTRIBUTION.read_text("direct_url.json") or "{}")
    return DISTRIBUTION.read_text("WHEEL") is not None and not origin.get("dir_info", {}).get(
        "editable", False
    )


wheel = pytest.mark.skipif(not is_wheel(), reason="an editable install, not a wheel: run scripts/test")


def sources() -> set[str]:
    """Return the files to be installed, as paths inside the package; server/api is the package itself."""
    return {
        path.relative_to(ROOT).as_posix().removeprefix("server/api/")
        for package in ("schemas", "builder", "server")
        for path in (ROOT / package).rglob("*")
        if path.suffix in (".py", ".md", ".json") or path.name == "py.typed" or is_asset(path)
    }


def is_asset(path: Path) -> bool:
    """Return whether a file belongs to the viewer's page."""
    return path.is_file() and path.is_relative_to(ROOT / "server/viewer/assets")


@wheel
def test_wheel_holds_every_module_and_data_file_and_nothing_more() -> None:
    files = [Path(str(file)) for file in DISTRIBUTION.files or ()]
    packaged = {Path(*file.parts[1:]).as_posix() for file in files if file.parts[0] == "solidcloud"}
    packaged = {name for name in packaged if "__pycache__" not in name}
    assert packaged == sources()


@wheel
def test_wheel_installs_no_bare_package() -> None:
    tops = {Path(str(file)).parts[0] for file in DISTRIBUTION.files or ()}
    assert {top for top in tops if top != ".." and not top.endswith(".dist-info")} == {"solidcloud"}


@wheel
def test_wheel_holds_the_licence() -> None:
    names = [str(file) for file in DISTRIBUTION.files or ()]
    assert any(name.endswith("licenses/LICENSE") for name in names)


@wheel
def test_tests_import_what_is_installed() -> None:
    from solidcloud import schemas

    assert not Path(schemas.__path__[0]).is_relative_to(ROOT / "schemas")


def pins() -> dict[str, str]:
    """Return name (normalised) -> version of scripts/requirements.txt."""
    lines = (ROOT / "scripts/requirements.txt").read_text().splitlines()
    pairs = [line.split("==") for line in lines if line and not line.startswith("#")]
    return {normalised(name): version for name, version in pairs}


def normalised(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_requirement_of_every_extra_is_pinned_to_a_version_it_allows() -> None:
    pinned = pins()
    wanted = [Requirement(text) for text in DISTRIBUTION.requires or ()]
    assert len(wanted) > 15
    for requirement in wanted:
        if requirement.name != "solidcloud":
            assert requirement.specifier.contains(pinned[normalised(requirement.name)]), requirement


def test_laspy_2_6_0_which_does_not_import_is_not_allowed() -> None:
    """Issue 35: it was withdrawn, but pip takes it where a lower bound names it."""
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    (laspy,) = (wanted for wanted in map(Requirement, extras["readers"]) if wanted.name == "laspy")
    assert not laspy.specifier.contains("2.6.0") and laspy.specifier.contains("2.6.1")


def test_a_wheel_with_kernels_requires_the_versions_that_they_belong_to(tmp_path: Path) -> None:
    project = tmp_path / "pyproject.toml"
    project.write_text((ROOT / "pyproject.toml").read_text())
    load_script("build_wheel").pin(project, (ROOT / "scripts/requirements.txt").read_text())
    required = [Requirement(text) for text in tomllib.loads(project.read_text())["project"]["dependencies"]]
    exact = {each.name: str(each.specifier) for each in required if each.name in ("numba", "llvmlite")}
    assert exact == {name: f"=={pins()[name]}" for name in ("numba", "llvmlite")}
    (numpy,) = (each.specifier for each in required if each.name == "numpy" and "==" in str(each.specifier))
    assert numpy.contains(pins()["numpy"]) and not numpy.contains("3.0")


def test_a_wheel_with_kernels_carries_no_marks(tmp_path: Path) -> None:
    for name in ("a-1.kernel", "b-3.compiling"):
        (tmp_path / name).touch()
    load_script("build_wheel").add_kernels(tmp_path, tmp_path / "compiled")
    assert [path.name for path in (tmp_path / "compiled").iterdir()] == ["a-1.kernel"]
