"""Checks and description of a scene file, for `solidcloud scene check`."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np

from ....schemas.scene.effect_table import Objects, Through, Uncertainty, effect_name
from ....schemas.scene.scene_file import SceneFile, identity, read_scene, scene_name, up_of
from ...archives.masked_store import MaskedStore
from ...archives.rigid_transform import transform_boxes
from ...archives.scene_info import run_order
from ...open_scene_file import (
    FoundArchive,
    FoundAvatar,
    error_location,
    find_archives,
    read_avatars,
)

# The origin of an avatar that stands on the highest point may be this far above it [m].
_STANDING_HEIGHT = 3.0


class Checked(NamedTuple):
    """A valid scene file.

    archives: closed.  left_out: number of scan points removed by the effect `through`.
    notes: sentences about settings that are valid but possibly unintended.
    """

    path: Path
    name: str
    file: SceneFile
    archives: list[FoundArchive]
    avatars: list[FoundAvatar]
    left_out: int
    notes: list[str]


def check_scene_file(path: Path) -> Checked:
    """Read a scene file and everything it names.

    Raises the same errors as `Scene.open`, except those about budgets, and CorruptError or OSError
    for a voxel that a box of `through` meets.
    """
    file = read_scene(path)
    name = scene_name(file, path)
    with ExitStack() as stack:
        archives = find_archives(file, path, stack)
        avatars = read_avatars(file, path)
        left_out = _removed_points(path, archives)
    return Checked(path, name, file, archives, avatars, left_out, list(_notes(file, archives, left_out)))


def scene_facts(checked: Checked) -> Iterator[tuple[str, str]]:
    """Yield names and values that describe a scene, for a table."""
    file = checked.file
    yield "scene", f"{checked.name}, {checked.path}"
    for item, found in zip(file.archives, checked.archives, strict=True):
        info = found.info
        posed = "" if item.pose == identity() else ", posed"
        models = ", ".join(info.radius_models)
        yield (
            "archive",
            f"{found.store.archive.folder}: {info.points:,} points in {info.voxels:,} voxels, radii {models}{posed}",
        )
    yield "up", _numbers(up_of(file))
    yield "radius model", file.radius_model or "the radius stored in each archive"
    for avatar in checked.avatars:
        made = avatar.info
        yield (
            f"avatar {made.name}",
            f"{avatar.file}: {made.points:,} points of {made.radius:.4g} m radius, {made.description}",
        )
    for thing in file.objects:
        x, y, z = (row[3] for row in thing.pose[:3])
        yield f"object {thing.name}", f"{thing.kind}, avatar {thing.avatar}, at {_numbers((x, y, z))} m"
    if file.spawn:
        yield "spawn", f"{_numbers(file.spawn.position)} m, heading {file.spawn.heading:g} degrees"
    yield "limits", _options(file.limits)
    by_name = {effect_name(effect): effect for effect in file.effects}
    steps = run_order(file)
    for number, name in enumerate(steps, 1):
        effect = by_name[name]
        if isinstance(effect, Through):
            boxes = ", ".join(box.name for box in effect.boxes)
            yield "at the start", f"through: {boxes}; {checked.left_out:,} points left out"
        else:
            options = _options(effect)
            yield f"effect {number - ('through' in steps)}", f"{name}{': ' if options else ''}{options}"
    if not steps:
        yield "effects", "none: nothing stops an avatar"
    for note in checked.notes:
        yield "note", note


def scene_json(checked: Checked) -> dict[str, Any]:
    """Return the description of a scene in JSON types.

    Its field `scene` holds the file as read, with defaults filled in.
    """
    return {
        "file": str(checked.path),
        "name": checked.name,
        "scene": msgspec.to_builtins(checked.file),
        "archives": [
            {
                "folder": str(found.store.archive.folder),
                "points": found.info.points,
                "voxels": found.info.voxels,
            }
            for found in checked.archives
        ],
        "avatars": [{"file": str(a.file), **msgspec.to_builtins(a.info)} for a in checked.avatars],
        "order": run_order(checked.file),
        "left_out": checked.left_out,
        "notes": checked.notes,
    }


def _removed_points(path: Path, archives: list[FoundArchive]) -> int:
    """Return the number of scan points that the effect `through` removes."""
    left_out = 0
    for number, found in enumerate(archives):
        if isinstance(found.store, MaskedStore):
            with error_location(path, f"$.archives[{number}]"):
                left_out += found.store.count_hidden()
    return left_out


def _notes(file: SceneFile, archives: list[FoundArchive], left_out: int) -> Iterator[str]:
    """Yield sentences about settings that are valid but possibly unintended."""
    for effect in file.effects:
        if isinstance(effect, Objects) and not file.objects:
            yield "the effect `objects` has nothing to do: there are no [[objects]]"
        if isinstance(effect, Through) and not left_out:
            yield "no scan point lies in a box of `through`: are the boxes in world coordinates, in metres?"
        if isinstance(effect, Uncertainty) and effect.scans:
            for found in archives:
                if not found.store.archive.header.scan_index:
                    yield (
                        f"{found.store.archive.folder} does not store the scan of its points (build --keep scan): "
                        "one sigma applies to all points"
                    )
    names = {effect_name(effect) for effect in file.effects}
    if "stop" in names and "sweep" not in names:
        yield "`stop` without `sweep`: an avatar may pass through anything thinner than its motion in one frame"
    if file.spawn is not None:
        low, high = _bounds(file, archives)
        standing = _STANDING_HEIGHT * np.array(file.up) / np.linalg.norm(file.up)
        low_place, high_place = low + np.minimum(standing, 0.0), high + np.maximum(standing, 0.0)
        if not np.all((low_place <= file.spawn.position) & (file.spawn.position <= high_place)):
            yield f"spawn lies outside the bounds of the archives, {_numbers(low)} .. {_numbers(high)} m"


def _bounds(file: SceneFile, archives: list[FoundArchive]) -> tuple[list[float], list[float]]:
    """Return the low and high corner of a box around all archives, world frame [m]."""
    lows, highs = [], []
    for item, found in zip(file.archives, archives, strict=True):
        low, high = np.array(found.info.bounds)[:, None]
        if item.pose != identity():
            low, high = transform_boxes(np.array(item.pose), low, high)
        lows.append(low[0])
        highs.append(high[0])
    return np.min(lows, axis=0).tolist(), np.max(highs, axis=0).tolist()


def _numbers(values: Any) -> str:
    """Format numbers."""
    return " ".join(f"{value:.6g}" for value in values)


def _options(part: Any) -> str:
    """Format the fields of a part of the file that are set, as written in the file."""
    fields = msgspec.to_builtins(part)
    fields.pop("effect", None)
    return ", ".join(f"{name} {value}" for name, value in fields.items() if value not in (None, {}))
