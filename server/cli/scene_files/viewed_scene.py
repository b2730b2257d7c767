"""Scene file of an archive for the viewer: its users walk on the ground, and every report is on."""

import re
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ....schemas.errors import BadRequestError
from ....schemas.scene.scene_file import FORMAT, SUFFIX
from .scene_text import toml_value

# Effects of a person who walks, with what a viewer shows: the nearest point and the contacts.
VIEWER_EFFECTS = ("stop", "sweep", "slide", "step", "ground", "proximity", "contacts")
_NAME = "viewer"
# Directions against gravity, by the name of the axis.
UP = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
# Characters that the name of a scene must not contain, and its maximum length.
_NO_NAME, _LONGEST_NAME = re.compile(r"[^A-Za-z0-9._-]+"), 64


@contextmanager
def viewed_scene(what: Path, up: str | None = None) -> Iterator[Path]:
    """Yield a scene file: the given one, or a temporary one of the given archive.

    up: axis of the archive against gravity, a key of `UP`; None: z. Raise BadRequestError if it is
    given for a scene file, which says it itself, or is no axis.
    """
    if up is not None and up not in UP:
        raise BadRequestError(f"--up {up!r}: expected one of {', '.join(UP)}")
    if what.suffix == SUFFIX:
        if up is not None:
            raise BadRequestError(f"--up is for archives: write `up = {list(UP[up])}` in {what.name}")
        yield what
        return
    with tempfile.TemporaryDirectory(prefix="solidcloud-view-") as folder:
        file = Path(folder) / f"{_NAME}{SUFFIX}"
        file.write_text(archive_scene(what, up), encoding="utf-8")
        yield file


def archive_scene(archive: Path, up: str | None = None) -> str:
    """Return the text of a scene file of one archive, named as its folder, whose users walk.

    up: axis against gravity, a key of `UP`; None: z.
    """
    folder = archive.resolve()
    name = _NO_NAME.sub("-", folder.name)[:_LONGEST_NAME] or _NAME
    lines = [f"format = {FORMAT}", f"name = {toml_value(name)}"]
    if up is not None:
        lines.append(f"up = {list(UP[up])}")
    lines += ["", "[[archives]]"]
    lines.append(f"path = {toml_value(str(folder))}")
    for effect in VIEWER_EFFECTS:
        lines += ["", "[[effects]]", f"effect = {toml_value(effect)}"]
    return "\n".join(lines) + "\n"
