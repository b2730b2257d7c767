"""Archives that the tests of seals share."""

import shutil
from pathlib import Path

import pytest
from sealed_archives import KEY, build_unsealed
from solidcloud.builder.edit.seal_archive import seal_archive


@pytest.fixture(scope="session")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The archive before it is sealed."""
    return build_unsealed(tmp_path_factory.mktemp("plain"))


@pytest.fixture(scope="session")
def sealed(plain: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same archive, sealed."""
    target = tmp_path_factory.mktemp("sealed") / "archive"
    shutil.copytree(plain, target)
    seal_archive(target, KEY)
    return target


@pytest.fixture
def copy(sealed: Path, tmp_path: Path) -> Path:
    """A copy of the sealed archive."""
    return Path(shutil.copytree(sealed, tmp_path / "archive"))
