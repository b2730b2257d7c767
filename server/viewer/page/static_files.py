"""Files of the page: those of the package, and no others."""

from pathlib import Path
from typing import NamedTuple

from ....schemas.errors import InternalError

_ASSETS = Path(__file__).resolve().parents[1] / "assets"
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
    ".wasm": "application/wasm",
}


class StaticFile(NamedTuple):
    """A file and its media type."""

    content: bytes
    media_type: str


def static_files() -> dict[str, StaticFile]:
    """Return all files of the page by the path of their address, `/` for the page itself.

    They are read once: an address is looked up in this table, and never joined to a path. Raise
    InternalError if the package lacks the page.
    """
    found = {
        "/" + path.relative_to(_ASSETS).as_posix(): StaticFile(path.read_bytes(), _TYPES[path.suffix])
        for path in sorted(_ASSETS.rglob("*"))
        if path.is_file() and path.suffix in _TYPES
    }
    if "/index.html" not in found:
        raise InternalError(f"{_ASSETS}: the page is missing: install solidcloud again")
    found["/"] = found["/index.html"]
    return found
