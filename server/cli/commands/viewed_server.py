"""Server that `solidcloud view` starts itself, and starts again with other effects."""

import tempfile
import threading
import tomllib
from collections.abc import Collection, Sequence
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from ....schemas.errors import BadRequestError, SolidcloudError
from ....schemas.runtime.text_encoding import decode_text
from ....schemas.scene.effect_table import effect_name
from ....schemas.scene.scene_file import parse_scene, read_scene, scene_name
from ....schemas.wire.warming_parts import SERVING_WORDS
from ...report.walk.server_process import free_port, served
from ..scene_files.scene_text import toml_value


class ViewedServer:
    """Server of a scene file; a context manager. `change` starts it again, at the same endpoint.

    endpoint: of the server.  declared: names of the effects of the scene file.
    The viewer's clients connect again by themselves, and their users continue where they were.
    """

    def __init__(self, file: Path, *options: str) -> None:
        """Make a server. options: of `solidcloud serve`. Raise BadRequestError for an invalid scene file."""
        self._file, self._scene, self._options = file, read_scene(file), options
        self.endpoint = f"tcp/127.0.0.1:{free_port()}"
        self.declared: Sequence[str] = [effect_name(effect) for effect in self._scene.effects]
        self._running = ExitStack()
        self._changing = threading.Lock()
        self._names = list(self.declared)

    def __enter__(self) -> Self:
        self._start(self._file)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._changing:
            self._running.close()

    def change(self, names: Sequence[str]) -> None:
        """Serve the scene with some of its effects; each keeps its options.

        Raise BadRequestError if they do not belong together: the server is then unchanged. Raise
        SolidcloudError if the server does not start: then it runs with the effects before.
        """
        with self._changing, tempfile.TemporaryDirectory(prefix="solidcloud-view-") as folder:
            file = Path(folder) / self._file.name
            text = scene_with_effects(self._file, names)
            parse_scene(text.encode(), self._file.name)
            if set(names) == set(self._names):
                return
            file.write_text(text, encoding="utf-8")
            self._running.close()
            try:
                self._start(file)
            except SolidcloudError:
                file.write_text(scene_with_effects(self._file, self._names), encoding="utf-8")
                self._start(file)
                raise
            self._names = list(names)

    def _start(self, file: Path) -> None:
        """Start the server of a scene file. Raise SolidcloudError."""
        # A temporary file may have another name than the scene that clients know.
        name = scene_name(self._scene, self._file)
        # The page shows the scan while kernels are compiled, which can take minutes.
        self._running.enter_context(
            served(file, name, *self._options, endpoint=self.endpoint, until=SERVING_WORDS)
        )


def scene_with_effects(file: Path, names: Collection[str]) -> str:
    """Return the text of a scene file with some of its effects, at any place.

    Raise BadRequestError for the name of another effect.
    """
    content: dict[str, Any] = tomllib.loads(decode_text(file.read_bytes()))
    effects = content.get("effects", [{"effect": "stop"}])
    known = {effect["effect"] for effect in effects}
    for name in names:
        if name not in known:
            raise BadRequestError(f"effect {name!r}: the scene file declares {', '.join(sorted(known))}")
    content["effects"] = [effect for effect in effects if effect["effect"] in names]
    for items, field in (("archives", "path"), ("avatars", "file")):
        for item in content.get(items, []):
            item[field] = str((file.parent / item[field]).resolve())
    return "".join(f"{key} = {toml_value(value)}\n" for key, value in content.items())
