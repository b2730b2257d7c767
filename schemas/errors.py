"""The exception tree, and the closed set of error codes sent on the wire.

Every message says where, what was found, what was expected and what to do. `code` is what a client on
the wire receives beside that sentence (WIRE.md, "Errors"); `exit_code` is what the command line returns.
"""

from enum import StrEnum
from pathlib import Path


class ErrorCode(StrEnum):
    """The codes an error reply may carry; closed, so that a client can branch on them."""

    BAD_REQUEST = "bad_request"
    BAD_TRANSFORM = "bad_transform"
    UNKNOWN_SCENE = "unknown_scene"
    UNKNOWN_AVATAR = "unknown_avatar"
    TOO_LARGE = "too_large"
    BUSY = "busy"
    EXPIRED = "expired"
    CORRUPT = "corrupt"
    DENIED = "denied"
    INTERNAL = "internal"


class SolidcloudError(Exception):
    """The root of every error this project raises on purpose."""

    code = ErrorCode.INTERNAL
    exit_code = 1


class BadRequestError(SolidcloudError):
    """A request that cannot be understood, or that holds a number no answer exists for."""

    code = ErrorCode.BAD_REQUEST
    exit_code = 2


class BadTransformError(BadRequestError):
    """A pose that is neither rigid nor rigid with a uniform scale (NUMERICS.md N6)."""

    code = ErrorCode.BAD_TRANSFORM


class UnknownSceneError(SolidcloudError):
    """No server that was reached serves a scene of this name."""

    code = ErrorCode.UNKNOWN_SCENE


class UnknownAvatarError(SolidcloudError):
    """This client has added no avatar of this name."""

    code = ErrorCode.UNKNOWN_AVATAR


class TooLargeError(BadRequestError):
    """A request over a stated cap."""

    code = ErrorCode.TOO_LARGE


class BusyError(SolidcloudError):
    """The server has as much work as it accepts; ask again later."""

    code = ErrorCode.BUSY


class ExpiredError(SolidcloudError):
    """A frame of a session took longer than the server spends on one."""

    code = ErrorCode.EXPIRED


class DeniedError(SolidcloudError):
    """The server does not allow this to this client."""

    code = ErrorCode.DENIED


class InternalError(SolidcloudError):
    """A fault of the server's own; its log has the rest."""

    code = ErrorCode.INTERNAL


class BadDataError(SolidcloudError):
    """A file that is not what it should be: a scan or an archive."""

    code = ErrorCode.CORRUPT
    exit_code = 3


class ScanError(BadDataError):
    """A scan that cannot be read: missing, broken, empty or of no known format."""


class FormatError(BadDataError):
    """An archive that cannot be read: not one, of another version, truncated or inconsistent."""


class CorruptError(FormatError):
    """A record whose bytes are not those that were written. paths: the files, or folders, where they lie, if known."""

    def __init__(self, message: str = "", paths: tuple[Path, ...] = ()) -> None:
        """Say `message`, which names the files for a reader."""
        super().__init__(message)
        self.paths = paths


class MisleadingIndexError(CorruptError):
    """A record that contradicts what questions believed of the index before they read it: which cell it is of, where in
    it its points are, how large their spheres.

    An index that is wrong once may be wrong about any voxel that was never read, so nothing is known to be clear.
    """


_BY_CODE: dict[ErrorCode, type[SolidcloudError]] = {
    cls.code: cls
    for cls in (
        BadRequestError,
        BadTransformError,
        UnknownSceneError,
        UnknownAvatarError,
        TooLargeError,
        BusyError,
        ExpiredError,
        CorruptError,
        DeniedError,
        InternalError,
    )
}


def error_from_code(code: str, message: str) -> SolidcloudError:
    """The exception that a reply with this code stands for; an unknown code is refused, not guessed."""
    try:
        return _BY_CODE[ErrorCode(code)](message)
    except ValueError:
        known = ", ".join(ErrorCode)
        return InternalError(
            f"error reply with code {code!r}: expected one of {known}: upgrade the client ({message})"
        )
