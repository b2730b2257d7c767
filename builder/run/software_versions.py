"""Software that the bytes of an archive may depend on: library versions, hash of the sources."""

import functools
import hashlib
import platform
from importlib import metadata
from pathlib import Path

LIBRARIES = ("numpy", "numba", "llvmlite", "h5py", "zstandard")


@functools.cache
def software_versions() -> dict[str, str]:
    """Return the software that a unit's bytes may depend on, name -> version.

    The version of solidcloud includes a hash of its sources.
    """
    root = Path(__file__).resolve().parents[2]
    sources = hashlib.sha256()
    for package in ("schemas", "builder"):
        for path in sorted((root / package).rglob("*.py")):
            sources.update(path.relative_to(root).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return {
        "solidcloud": f"{metadata.version('solidcloud')} ({sources.hexdigest()[:12]})",
        "Python": platform.python_version(),
        **{name: metadata.version(name) for name in LIBRARIES},
    }
