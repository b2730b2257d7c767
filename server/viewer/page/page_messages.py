"""Messages between the viewer's process and a page: DESIGN.md describes them.

Texts are JSON. A binary message holds arrays: the page makes typed arrays on its bytes without
copying them.
"""

import json
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from ....schemas.errors import BadRequestError
from ....schemas.wire.tile_messages import MAX_SPHERE_LEVEL

# Version of these messages; a page of another version asks its user to reload it.
PAGE_VERSION = 1
# What a page shows of an error that is not expected.
FAILED = "The viewer failed at something: its log says at what."
# Arrays begin at multiples of this, as typed arrays of 8 bytes require [bytes].
_ALIGNMENT = 8
# Longest part of a file of poses [characters]: a character takes at most 6 bytes of a message.
PATH_PART = 10_000

Share = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]
Angle = Annotated[float, msgspec.Meta(ge=-1e4, le=1e4)]
Metres = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Place = tuple[Metres, Metres, Metres]
Number = Annotated[int, msgspec.Meta(ge=-(1 << 31), lt=1 << 31)]
# Archive, voxel, detail.
TileKey = tuple[Number, Number, Number, Number, Annotated[int, msgspec.Meta(ge=0, le=8)]]


class Hello(msgspec.Struct, frozen=True, tag="hello"):
    """First message of a page.

    at: place of the user's feet in the world [m], and the direction that it faces [degrees]; null:
    a place that the viewer finds.
    """

    version: int
    at: tuple[Metres, Metres, Metres, Angle] | None = None


class Intent(msgspec.Struct, frozen=True, tag="intent"):
    """Motion that the user wants, until the next message.

    forward, right, up: shares of the speed, relative to the view.  yaw: direction of the view about
    the up axis [rad].  face: turn towards the view, also while standing.
    """

    forward: Share = 0.0
    right: Share = 0.0
    up: Share = 0.0
    yaw: Angle = 0.0
    run: bool = False
    face: bool = False


class Want(msgspec.Struct, frozen=True, tag="want"):
    """Tiles that the page still lacks, most urgent first; replaces the list before."""

    tiles: Annotated[list[TileKey], msgspec.Meta(max_length=256)]


class Around(msgspec.Struct, frozen=True, tag="around"):
    """Request for the voxels near a place of the page's frame [m]."""

    place: Place


class Boom(msgspec.Struct, frozen=True, tag="boom"):
    """Request how far a line from a place of the page's frame is free of the scan.

    place: [m].  way: its direction.  reach: its length [m].
    """

    place: Place
    way: tuple[Share, Share, Share]
    reach: Annotated[float, msgspec.Meta(gt=0.0, le=100.0)]


class Restart(msgspec.Struct, frozen=True, tag="restart"):
    """Put the user back to where it began, or to another place.

    at: as in `Hello`.
    """

    at: tuple[Metres, Metres, Metres, Angle] | None = None


class Measure(msgspec.Struct, frozen=True, tag="measure"):
    """Request the answers for the user's pose: exact, and with a tolerance [m]."""

    tolerance: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]


class Spheres(msgspec.Struct, frozen=True, tag="spheres"):
    """Request the bounding spheres of a level in the voxels at a place of the page's frame [m]."""

    place: Place
    level: Annotated[int, msgspec.Meta(ge=0, le=MAX_SPHERE_LEVEL)]


class SwitchEffects(msgspec.Struct, frozen=True, tag="switch"):
    """Serve the scene with these effects."""

    names: Annotated[list[Annotated[str, msgspec.Meta(max_length=64)]], msgspec.Meta(max_length=32)]


class PathText(msgspec.Struct, frozen=True, tag="path"):
    """Part of a file of poses, whose clashes are wanted.

    name: of the file; its suffix selects the format.  first, last: whether it is the file's first
    part, and its last.
    """

    name: Annotated[str, msgspec.Meta(max_length=255)]
    text: Annotated[str, msgspec.Meta(max_length=PATH_PART)]
    first: bool
    last: bool


class StopCheck(msgspec.Struct, frozen=True, tag="stop"):
    """End the check of a path, or the writing of a file."""


class ShowClash(msgspec.Struct, frozen=True, tag="show"):
    """Request the contacts of a clash and a viewpoint. number: in the list, from 1."""

    number: Number


class SaveClashes(msgspec.Struct, frozen=True, tag="save"):
    """Request the clashes as a file."""

    form: Literal["csv", "json", "bcf"]


ClashMessage = PathText | StopCheck | ShowClash | SaveClashes
FromPage = Hello | Intent | Want | Around | Boom | Restart | Measure | Spheres | SwitchEffects | ClashMessage
_DECODER = msgspec.json.Decoder(FromPage)


def read_message(text: str | bytes) -> FromPage:
    """Return a message of a page. Raise BadRequestError."""
    if not isinstance(text, str):
        raise BadRequestError("a binary message: a page sends texts only")
    try:
        return _DECODER.decode(text)
    except msgspec.MsgspecError as error:
        raise BadRequestError(f"message of a page: {error}") from None


def text_message(kind: str, **fields: Any) -> str:
    """Return a text for the page."""
    return json.dumps({"type": kind, **fields}, separators=(",", ":"))


def binary_message(kind: str, arrays: Mapping[str, NDArray], **fields: Any) -> bytes:
    """Return a binary message for the page.

    It consists of the length of the header (4 bytes, little-endian), the header, padded with
    spaces, and the arrays. The header is JSON: `type`, `fields`, and for each of `arrays` its dtype
    in numpy's notation, its shape and its first byte after the header.
    """
    listed: dict[str, list[Any]] = {}
    parts: list[bytes] = []
    size = 0
    for name, array in arrays.items():
        plain = np.ascontiguousarray(array, array.dtype.newbyteorder("<"))
        kind_of = f"{plain.dtype.kind}{plain.dtype.itemsize}"
        listed[name] = [kind_of, list(plain.shape), size]
        padding = -plain.nbytes % _ALIGNMENT
        parts += [plain.tobytes(), b"\0" * padding]
        size += plain.nbytes + padding
    header = json.dumps({"type": kind, **fields, "arrays": listed}, separators=(",", ":")).encode()
    header += b" " * (-(len(header) + 4) % _ALIGNMENT)
    return b"".join([len(header).to_bytes(4, "little"), header, *parts])


class PageConnection(Protocol):
    """Connection to a page: iterating yields its messages until it is closed."""

    def __iter__(self) -> Any: ...
    def send(self, message: str | bytes) -> None: ...
    def is_open(self) -> bool: ...
