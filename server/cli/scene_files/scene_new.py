"""Creation of a scene file, after checking everything it names."""

import errno
import os
import re
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, closing
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from ....builder.synthetic.figure import HEIGHT, figure_points
from ....schemas.archive.radius_model import STORED_MODELS
from ....schemas.errors import BadRequestError, SolidcloudError
from ....schemas.runtime.new_file import new_file
from ....schemas.runtime.os_errors import write_error_words
from ....schemas.scene.scene_file import SUFFIX, SceneFile, parse_scene, scene_name
from ....schemas.wire.key_expressions import check_name
from ...archives.scene_info import describe
from ...open_scene_file import find_archives, open_archives, read_avatars
from ...residency.voxel_store import VoxelStore
from ...scene import DEFAULT_BUDGET, Scene
from ...scene_interface import AvatarShape
from .scene_text import SceneContent, scene_text
from .spawn_search import CLEARANCE, add_body, find_spawn

# Characters that an avatar's name must not contain (schemas/scene/scene_file.py, SceneName), and
# its maximum length.
_NO_NAME = re.compile(r"[^A-Za-z0-9._-]+")
_LONGEST_NAME = 64
# Points of the figure that stands at the spawn of a scene without avatars.
_FIGURE_POINTS = 1000


def new_scene(
    out: Path,
    archives: Sequence[Path],
    avatars: Sequence[Path],
    *,
    effects: Sequence[str],
    name: str | None = None,
    overwrite: bool = False,
    avatar_options: Mapping[str, Any] = MappingProxyType({}),
) -> Sequence[float] | None:
    """Write a scene file with archives, avatars named after their files, effects, and a spawn.

    Returns the position of the spawn, None if no place for it was found.
    overwrite: replace an existing file.
    avatar_options: fields of all avatars, besides name and file.
    Raises BadRequestError for content that a scene file must not have and for an existing file,
    FormatError or CorruptError for an invalid archive, ScanError for an invalid avatar.
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
        [
            {"name": called, "file": _relative(file, out), **avatar_options}
            for called, file in _avatar_names(avatars).items()
        ],
        effects,
        name,
        [model for model in STORED_MODELS if all(model in info.radius_models for info in infos)],
        bounds[:, 0].min(axis=0).tolist(),
        bounds[:, 1].max(axis=0).tolist(),
    )
    text = scene_text(begin).encode()
    parsed = parse_scene(text, f"{out} (not written)")
    called = scene_name(parsed, out)
    if os.path.lexists(out) and not overwrite:
        raise BadRequestError(f"{out} exists: give another -o, or --overwrite to replace it")
    if not out.absolute().parent.is_dir():
        error = FileNotFoundError(errno.ENOENT, "")
        raise SolidcloudError(f"{out}: cannot be written: {write_error_words(error, out)}")
    spawn, note = _find_spawn(parsed, out, called)
    text = scene_text(begin._replace(spawn=spawn, spawn_note=note)).encode()
    try:
        with new_file(out) as file:
            file.write(text)
    except OSError as error:
        raise SolidcloudError(f"{out}: cannot be written: {write_error_words(error, out)}") from None
    return spawn


def _find_spawn(file: SceneFile, out: Path, name: str) -> tuple[Sequence[float] | None, str]:
    """Return a position where the avatars of a scene file stand, if one is found, and a note on it.

    Without avatars, a generated figure takes their place.
    """
    with ExitStack() as stack:
        found = find_archives(file, out, stack)
        given = {
            each.info.name: AvatarShape(each.model.points, each.model.radius, each.model.inner_points)
            for each in read_avatars(file, out)
        }
        who = ", ".join(given)
        if not given:
            given, who = {"figure": AvatarShape(figure_points(_FIGURE_POINTS))}, f"a figure of {HEIGHT:g} m"
        try:
            archives = open_archives(file, out, name, found, DEFAULT_BUDGET, "lru", lambda _: None)
            with Scene(archives, name) as scene:
                spawn = find_spawn(scene, add_body(scene, given))
        except SolidcloudError as error:
            words = "".join(each if each.isprintable() else " " for each in str(error))
            return None, f"No place to stand could be searched: {words}."
    if spawn is None:
        return None, f"No place near the middle was found where {who} would stand clear on a floor."
    return spawn, f"Tried when this file was written: {who} clear, {CLEARANCE:g} m above a floor."


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
