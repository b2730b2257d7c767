"""Scene file of an archive for the viewer: its users walk on the ground, and every report is on."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from ....schemas.scene.scene_file import FORMAT, SUFFIX
from .scene_text import toml_value

# Effects of a person who walks, with what a viewer shows: the nearest point and the contacts.
VIEWER_EFFECTS = ("stop", "sweep", "slide", "step", "ground", "proximity", "contacts")
_NAME = "viewer"


@contextmanager
def viewed_scene(what: Path) -> Iterator[Path]:
    """Yield a scene file: the given one, or a temporary one of the given archive."""
    if what.suffix == SUFFIX:
        yield what
        return
    with tempfile.TemporaryDirectory(prefix="solidcloud-view-") as folder:
        file = Path(folder) / f"{_NAME}{SUFFIX}"
        file.write_text(archive_scene(what), encoding="utf-8")
        yield file


def archive_scene(archive: Path) -> str:
    """Return the text of a scene file of one archive, whose users walk."""
    lines = [f"format = {FORMAT}", f"name = {toml_value(_NAME)}", "", "[[archives]]"]
    lines.append(f"path = {toml_value(str(archive.resolve()))}")
    for name in VIEWER_EFFECTS:
        lines += ["", "[[effects]]", f"effect = {toml_value(name)}"]
    return "\n".join(lines) + "\n"
