"""Paths that the viewer checks: from a file, or in parts from a page."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.errors import TooLargeError
from ...cli.input.pose_file import parse_path, read_path
from ..page.page_messages import PathText

# Longest file of poses that a page may send [characters]: 100,000 poses in full precision.
MAX_PATH_TEXT = 32 << 20


class GivenPath(NamedTuple):
    """Path of the avatar. name: of its file.  times: (k,) [s].  poses: (k, 4, 4), avatar to world."""

    name: str
    times: NDArray[np.float64]
    poses: NDArray[np.float64]


def read_given_path(path: Path) -> GivenPath:
    """Return the path of a file. Raise the errors of `read_path`."""
    return GivenPath(path.name, *read_path(path))


class PathParts:
    """Parts of a file that a page sends."""

    def __init__(self) -> None:
        """Begin without parts."""
        self._parts: list[str] = []
        self._size = 0

    def take(self, message: PathText) -> GivenPath | None:
        """Return the path with its last part, None before.

        Raise BadRequestError for invalid text, TooLargeError for too much of it.
        """
        if message.first:
            self._parts, self._size = [], 0
        self._size += len(message.text)
        if self._size <= MAX_PATH_TEXT:
            self._parts.append(message.text)
        if not message.last:
            return None
        text, self._parts = "".join(self._parts), []
        if self._size > MAX_PATH_TEXT:
            raise TooLargeError(
                f"{message.name}: {self._size:,} characters: at most {MAX_PATH_TEXT:,}: check it in pieces"
            )
        return GivenPath(message.name, *parse_path(message.name, text.removeprefix("\ufeff")))
