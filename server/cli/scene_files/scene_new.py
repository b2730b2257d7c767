"""Creation of a scene file, after checking everything it names."""

import os
import re
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path

import numpy as np

from ....schemas.archive.radius_model import STORED_MODELS
from ....schemas.errors import BadRequestError, SolidcloudError
from ....schemas.process.new_file import new_file
from ....schemas.process.os_errors import write_error_words
from ....schemas.scene.scene_file import SUFFIX, parse_scene, scene_name
from ....schemas.wire.key_expressions import check_name
from ...archives.archive_info import describe
from ...residency.voxel_store import VoxelStore
from .scene_text import SceneContent, scene_text

# Characters that an avatar's name must not contain (schemas/scene/scene_file.py, SceneName), and
# its maximum length.
_NO_NAME = re.compile(r"[^A-Za-z0-9._-]+")
_LONGEST_NAME = 64


def new_scene(
    out: Path,
    archives: Sequence[Path],
    avatars: Sequence[Path],
    *,
    effects: Sequence[str],
    name: str | None = None,
    force: bool = False,
) -> None:
    """Write a scene file with archives, avatars named after their files, and effects.

    force: replace an existing file.
    Raises BadRequestError for content that a scene file must not have and for an existing file,
    FormatError or CorruptError for an invalid archive.
    """
    if out.suffix != SUFFIX:
        raise BadRequestError(
            f"{out}: expected a name that ends in {SUFFIX}, by which `serve` recognises a scene file"
        )
    if not archives:
        raise BadRequestError("no archive given: expected at least one")
    if name is not None:
        check_name(name, "--name")
    infos = []
    for folder in archives:
        with closing(VoxelStore(folder)) as store:
            infos.append(describe(store, folder.resolve().name))
    bounds = np.array([info.bounds for info in infos])
    begin = SceneContent(
        [_relative(folder, out) for folder in archives],
        [(called, _relative(file, out)) for called, file in _avatar_names(avatars).items()],
        effects,
        name,
        [model for model in STORED_MODELS if all(model in info.radius_models for info in infos)],
        bounds[:, 0].min(axis=0).tolist(),
        bounds[:, 1].max(axis=0).tolist(),
    )
    text = scene_text(begin).encode()
    scene_name(parse_scene(text, f"{out} (not written)"), out)
    if os.path.lexists(out) and not force:
        raise BadRequestError(f"{out} exists: give another -o, or --force to replace it")
    try:
        with new_file(out) as file:
            file.write(text)
    except OSError as error:
        raise SolidcloudError(f"{out}: cannot be written: {write_error_words(error, out)}") from None


def _avatar_names(avatars: Sequence[Path]) -> dict[str, Path]:
    """Return the files of avatars by avatar name.

    The name is that of the file, with - for characters that a name must not contain.
    """
    found: dict[str, Path] = {}
    for file in avatars:
        if not file.is_file():
            raise BadRequestError(f"{file}: no such file, expected points of an avatar")
        called = _NO_NAME.sub("-", file.stem)[:_LONGEST_NAME]
        if called in found:
            raise BadRequestError(
                f"--avatar {file}: its avatar would have the name {called}, as that of {found[called]}: expected "
                "different names: rename one of the files"
            )
        found[called] = file
    return found


def _relative(path: Path, out: Path) -> str:
    """Return a path relative to the folder of the scene file `out`."""
    return os.path.relpath(path.resolve(), out.parent.resolve())
