"""A new scene file, written where there is none, once all it names was found whole."""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from ..schemas.errors import BadRequestError, SolidcloudError
from ..schemas.radius_model import STORED_MODELS
from ..schemas.scene import parse_scene, scene_name
from .describe import describe
from .scene_text import Beginning, scene_text
from .store import Store


def new_scene(
    out: Path,
    archives: Sequence[Path],
    avatars: Sequence[Path],
    *,
    effects: Sequence[str],
    name: str | None = None,
    force: bool = False,
) -> None:
    """Write a scene file of archives, avatars by their files' names, and effects.

    force: replace what is there. Raises BadRequestError for what such a file may not say, and where one is there;
    FormatError or CorruptError for an archive that is none.
    """
    if out.suffix != ".toml":
        raise BadRequestError(
            f"{out}: expected a name that ends in .toml, by which `serve` knows a scene file"
        )
    if not archives:
        raise BadRequestError("no archive given: expected at least one")
    infos = []
    for folder in archives:
        store = Store(folder)
        infos.append(describe(store, folder.resolve().name))
        store.close()
    for file in avatars:
        if not file.is_file():
            raise BadRequestError(f"{file}: no such file, expected points of an avatar")
    bounds = np.array([info.bounds for info in infos])
    begin = Beginning(
        [_relative(folder, out) for folder in archives],
        [(file.stem, _relative(file, out)) for file in avatars],
        effects,
        name,
        [model for model in STORED_MODELS if all(model in info.radius_models for info in infos)],
        bounds[:, 0].min(axis=0).tolist(),
        bounds[:, 1].max(axis=0).tolist(),
    )
    text = scene_text(begin).encode()
    scene_name(parse_scene(text, str(out)), out)
    try:
        with open(out, "wb" if force else "xb") as opened:
            opened.write(text)
    except FileExistsError:
        raise BadRequestError(f"{out} is there: give another -o, or --force to replace it") from None
    except OSError as error:
        raise SolidcloudError(f"{out}: {error.strerror}") from None


def _relative(path: Path, out: Path) -> str:
    """A path as the file has it: relative to it."""
    return os.path.relpath(path.resolve(), out.resolve().parent)
