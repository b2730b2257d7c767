"""Finding, checking and opening the archives and avatars that a scene file names.

Errors name the file and the place in it. The code of an effect is imported only for
scenes with it.
"""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from ..schemas.archive.radius_model import class_radii
from ..schemas.archive.units import UNITS_PER_METRE
from ..schemas.errors import BadRequestError, SolidcloudError
from ..schemas.scene.effect_table import Crowd, Objects, Through, Uncertainty
from ..schemas.scene.scene_file import SUFFIX, SceneFile
from ..schemas.wire.requests import AddAvatarRequest, make_positions
from ..schemas.wire.scene_messages import AvatarInfo, SceneInfo
from .archives.placed_archive import PlacedArchive
from .archives.scene_info import describe
from .avatars.avatar_model import AvatarModel, describe_avatar, make_avatar
from .avatars.avatar_shape import avatar_shape
from .kernels.core.placed_avatar import MAX_REACH_UNITS
from .residency.arena import ArenaBuffer
from .residency.voxel_store import OpenStore, VoxelStore

# Maximum radius of avatars that may collide with one another [m]: two of them and a margin stay
# within the reach of a pair (simulation/world/bodies.py).
MAX_BODY_RADIUS = MAX_REACH_UNITS / 4 / UNITS_PER_METRE


class FoundArchive(NamedTuple):
    """Archive that a scene file names. store: opened.  info: its description."""

    store: VoxelStore
    info: SceneInfo


class FoundAvatar(NamedTuple):
    """Avatar that a scene file names."""

    file: Path
    model: AvatarModel
    info: AvatarInfo


def is_scene_file(path: Path) -> bool:
    """Return whether a path names a scene file and not an archive folder. It need not exist."""
    return path.suffix == SUFFIX and not path.is_dir()


def find_archives(file: SceneFile, path: Path, stack: ExitStack) -> list[FoundArchive]:
    """Open the archives that a scene file names; check that each stores what the scene file requires.

    path: of the scene file, for errors and for relative paths.  stack: closes the archives.
    Raise FormatError, CorruptError or BadRequestError.
    """
    found = []
    for number, item in enumerate(file.archives):
        with error_location(path, f"$.archives[{number}].path"):
            store = store_opener(file, number)(_resolve_relative(path, item.path))
        stack.callback(store.close)
        header = store.archive.header
        if file.radius_model is not None:
            with error_location(path, f"$.radius_model: {store.archive.folder}"):
                class_radii(file.radius_model, header.radius, header.models)
        found.append(FoundArchive(store, describe(store, store.archive.folder.name)))
    _check_noise(file, path, found)
    return found


def read_avatars(file: SceneFile, path: Path) -> list[FoundAvatar]:
    """Return the avatars that a scene file names. Raise BadRequestError and the errors of `avatar_shape`."""
    found = []
    meet = any(isinstance(effect, Objects | Crowd) for effect in file.effects)
    for number, item in enumerate(file.avatars):
        avatar_file = _resolve_relative(path, item.file)
        with error_location(path, f"$.avatars[{number}].file"):
            shape = avatar_shape(
                avatar_file, item.radius, up=item.up, units=item.units, scale=item.scale, hollow=item.hollow
            )
        with error_location(path, f"$.avatars[{number}]"):
            points = make_positions(shape.points)
            asked = AddAvatarRequest(item.name, points, shape.radius, shape.inner_points)
            model = make_avatar(asked.points, asked.radius, asked.inner_points)
            if meet and model.radius > MAX_BODY_RADIUS:
                raise BadRequestError(
                    f"avatar radius {model.radius:g} m: expected at most {MAX_BODY_RADIUS:g} m with the effect "
                    "`objects` or `crowd`, under which avatars collide with others"
                )
        found.append(FoundAvatar(avatar_file, model, describe_avatar(item.name, model, shape.description)))
    return found


def store_opener(file: SceneFile, number: int) -> OpenStore:
    """Return the function that opens the folder of archive `number`.

    It leaves out the points that the effect `through` removes.
    """
    for effect in file.effects:
        if isinstance(effect, Through):
            from .archives.masked_store import MaskedStore

            boxes = [(box.low, box.high) for box in effect.boxes]
            return partial(MaskedStore, boxes=boxes, pose=file.archives[number].pose)
    return VoxelStore


def share_budget(budget_bytes: int, sizes: list[NDArray[np.int64]]) -> list[int]:
    """Divide a cache budget among archives.

    Each archive gets the size of its largest voxel. The rest is divided in proportion to the total
    sizes.
    sizes: for each archive (v,), the decoded size of each voxel [bytes].
    Raises BadRequestError if the largest voxels together exceed the budget.
    """
    if len(sizes) == 1:
        return [budget_bytes]  # `VoxelCache` reports a budget that is too small
    least = [ArenaBuffer.rounded(int(each.max(initial=0))) for each in sizes]
    rest = budget_bytes - sum(least)
    if rest < 0:
        raise BadRequestError(
            f"cache of {budget_bytes} bytes: the largest voxels of {len(sizes)} archives take {sum(least)}: give a "
            "larger --cache, or build with a smaller --voxel"
        )
    whole = [int(each.sum()) for each in sizes]
    return [low + rest * size // max(sum(whole), 1) for low, size in zip(least, whole, strict=True)]


def open_archives(
    file: SceneFile,
    path: Path,
    name: str,
    found: list[FoundArchive],
    budget_bytes: int,
    policy: str,
    took: Callable[[float], None],
    level_bytes: int | None = None,
) -> list[PlacedArchive]:
    """Place the archives of a scene, which the caller closes.

    name: of the scene.  found: by `find_archives`.  budget_bytes: limit of decoded voxels, all archives together.
    policy: eviction policy, see voxel_cache.py.  took: called with the duration of each voxel load
    [s].  level_bytes: of the budget for levels, see `Scene.open`.
    Raise the errors of opening, prefixed with the place in the scene file, after closing all.
    """
    with error_location(path, "$.archives"):
        budgets = share_budget(budget_bytes, [each.store.sizes for each in found])
    opened: list[PlacedArchive] = []
    with ExitStack() as stack:
        for number, (each, budget, item) in enumerate(zip(found, budgets, file.archives, strict=True)):
            with error_location(path, f"$.archives[{number}]"):
                archive = PlacedArchive(
                    each.store.archive.folder,
                    name,
                    budget_bytes=budget,
                    policy=policy,
                    open_store=store_opener(file, number),
                    store=each.store,
                    radius_model=file.radius_model,
                    pose=item.pose,
                    took=took,
                    level_bytes=None if level_bytes is None else level_bytes * budget // sum(budgets),
                )
            stack.callback(archive.close)
            opened.append(archive)
        stack.pop_all()
    return opened


def _resolve_relative(path: Path, named: str) -> Path:
    """Return a path that a scene file names, which is relative to the file's folder.

    Symbolic links are not resolved here: each opening follows them, so that a reload finds their
    new targets.
    """
    folder, there = path.parent.resolve(), Path(named)
    while there.parts[:1] == ("..",):
        folder, there = folder.parent, Path(*there.parts[1:])
    return folder / there


def _check_noise(file: SceneFile, path: Path, found: list[FoundArchive]) -> None:
    """Raise BadRequestError if the effect `uncertainty` names a scan that no archive lists."""
    for number, effect in enumerate(file.effects):
        if isinstance(effect, Uncertainty):
            from .simulation.effects.uncertainty_effect import check

            sources = [source for each in found for source in each.info.sources]
            with error_location(path, f"$.effects[{number}]"):
                check(effect, structs.replace(found[0].info, sources=sources))


@contextmanager
def error_location(path: Path, place: str) -> Iterator[None]:
    """Prefix errors raised in this block with the scene file and the place in it."""
    try:
        yield
    except SolidcloudError as error:
        error.args = (f"{path}: {place}: {error}",)
        raise
    except OSError as error:
        raise BadRequestError(f"{path}: {place}: {error}") from None
