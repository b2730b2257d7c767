"""The public names of `import solidcloud`, and the libraries that they load."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import archive_cases
import numpy as np
import pytest
import solidcloud
from solidcloud.schemas import errors

HEAVY = ("numba", "llvmlite", "h5py")
LOADED = "print(json.dumps([name for name in sys.modules if '.' not in name]))"


def loaded_by(code: str) -> set[str]:
    """Return the libraries that a fresh process has loaded after the code."""
    done = subprocess.run(
        [sys.executable, "-P", "-c", f"import json, sys; {code}; {LOADED}"],
        capture_output=True,
        text=True,
        check=True,
    )
    return set(json.loads(done.stdout.splitlines()[-1]))


def test_the_import_loads_no_library() -> None:
    loaded = loaded_by("import solidcloud")
    assert loaded - {"solidcloud"} <= sys.stdlib_module_names | loaded_by("pass")


def test_the_client_loads_neither_numba_nor_h5py() -> None:
    loaded = loaded_by("import solidcloud; solidcloud.Client; solidcloud.Verdict")
    assert "zenoh" in loaded and not loaded & {*HEAVY}


@pytest.mark.parametrize("name", solidcloud.__all__)
def test_every_name_is_there(name: str) -> None:
    assert getattr(solidcloud, name) is not None
    assert name in dir(solidcloud)


def test_every_error_is_public() -> None:
    found = {
        name
        for name, value in vars(errors).items()
        if isinstance(value, type) and issubclass(value, errors.SolidcloudError)
    }
    assert found == {name for name in solidcloud.__all__ if name.endswith("Error")}
    assert solidcloud.CorruptError is errors.CorruptError


def test_another_name_is_not_there() -> None:
    with pytest.raises(AttributeError, match="no attribute 'walker'"):
        _: Any = solidcloud.walker  # type: ignore[attr-defined]


def test_an_archive_and_a_scene_file_are_opened(tmp_path: Path) -> None:
    case = archive_cases.build(tmp_path, np.zeros((1, 3)), radius=0.1)
    file = tmp_path / "scene.toml"
    file.write_text(f'format = 1\n[[archives]]\npath = "{case.archive}"\n[[effects]]\neffect = "stop"\n')
    for path in (case.archive, file):
        with solidcloud.open(path, name="hall") as scene:
            assert scene.name == "hall"
            scene.add_avatar("ball", np.zeros((1, 3)), 0.1)
            assert scene.collide("ball", np.eye(4)[None]).verdict[0] == solidcloud.Verdict.CONTACT
