"""Collision detection with scanned point clouds: the public names of `import solidcloud`.

`open` and `Scene` answer in this process, `connect` and `Client` over zenoh. `poses` makes poses
from quaternions, Euler angles and rotations. Each name is imported when it is first used: `import
solidcloud` alone loads no library, and `Client` loads neither numba nor h5py. Setuptools installs
this folder as the package `solidcloud`, to which its imports are relative. May import
server/client.py, server/scene.py, schemas.
"""

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from pathlib import Path

    from . import poses
    from .schemas.errors import (
        BadDataError,
        BadRequestError,
        BadTransformError,
        BusyError,
        CorruptError,
        DeniedError,
        ExpiredError,
        FormatError,
        InternalError,
        MisleadingIndexError,
        ScanError,
        SolidcloudError,
        TooLargeError,
        UnknownAvatarError,
        UnknownSceneError,
    )
    from .schemas.wire.answers import Verdict
    from .server.client import Client
    from .server.scene import Scene

    __version__: str

__all__ = [
    "BadDataError",
    "BadRequestError",
    "BadTransformError",
    "BusyError",
    "Client",
    "CorruptError",
    "DeniedError",
    "ExpiredError",
    "FormatError",
    "InternalError",
    "MisleadingIndexError",
    "ScanError",
    "Scene",
    "SolidcloudError",
    "TooLargeError",
    "UnknownAvatarError",
    "UnknownSceneError",
    "Verdict",
    "__version__",
    "connect",
    "open",
    "poses",
]

_MODULES = {
    "Client": ".server.client",
    "Scene": ".server.scene",
    "Verdict": ".schemas.wire.answers",
    "poses": ".poses",
    **{name: ".schemas.errors" for name in __all__ if name.endswith("Error")},
}


def open(path: "str | Path", **options: Any) -> "Scene":
    """Open an archive folder or a scene file in this process, for a `with`.

    options: name, budget_bytes, policy and others, as in `Scene.open`.
    Raises BadRequestError for an invalid scene file or option, FormatError or CorruptError for an
    invalid archive.
    """
    from .server.scene import Scene

    return Scene.open(path, **options)


def connect(endpoint: str | None = None, *, scene: str, **options: Any) -> "Client":
    """Return a client of a scene that a server at `endpoint` serves, for a `with`.

    endpoint: such as tcp/127.0.0.1:7447; None: the default of `solidcloud serve`.
    options: timeout [s] and key_file, as in `Client`.
    """
    from .server.client import Client

    return Client(scene=scene, **options) if endpoint is None else Client(endpoint, scene=scene, **options)


def __getattr__(name: str) -> Any:
    """Import a public name on first use."""
    if name == "__version__":
        from importlib import metadata

        value: Any = metadata.version("solidcloud")
    elif name in _MODULES:
        module = importlib.import_module(_MODULES[name], __name__)
        value = module if name == "poses" else getattr(module, name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    """Return the public names and the loaded modules."""
    return sorted({*globals(), *__all__})
