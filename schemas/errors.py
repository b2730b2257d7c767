"""Exception hierarchy, and the closed set of error codes sent on the wire.

Every message says where the error is, what was found, what was expected and what to do.
A client on the wire receives `code` beside that sentence (WIRE.md, "Errors"). The command line
returns `exit_code`. To add an error code, add it to `ErrorCode`, to `_BY_CODE` with its exception,
and to WIRE.md.
"""

from enum import StrEnum
from pathlib import Path


class ErrorCode(StrEnum):
    """Codes of error replies. The set is closed, so that a client can branch on them."""

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
    """Base class of all errors that this package raises deliberately."""

    code = ErrorCode.INTERNAL
    exit_code = 1


class BadRequestError(SolidcloudError):
    """Request that cannot be parsed, or that contains a number for which no answer is defined."""

    code = ErrorCode.BAD_REQUEST
    exit_code = 2


class BadTransformError(BadRequestError):
    """Pose that is not rigid (NUMERICS.md N6)."""

    code = ErrorCode.BAD_TRANSFORM


class UnknownSceneError(SolidcloudError):
    """Name of a scene that none of the reached servers serves."""

    code = ErrorCode.UNKNOWN_SCENE


class UnknownAvatarError(SolidcloudError):
    """Avatar name that this client has not added."""

    code = ErrorCode.UNKNOWN_AVATAR


class TooLargeError(BadRequestError):
    """Request that exceeds a stated limit."""

    code = ErrorCode.TOO_LARGE


class BusyError(SolidcloudError):
    """Server at its work limit. The client should repeat the request later."""

    code = ErrorCode.BUSY


class ExpiredError(SolidcloudError):
    """Session frame that exceeded the server's time limit for one frame."""

    code = ErrorCode.EXPIRED


class DeniedError(SolidcloudError):
    """Operation that the server does not allow to this client."""

    code = ErrorCode.DENIED


class InternalError(SolidcloudError):
    """Fault inside the server. The server's log has the details."""

    code = ErrorCode.INTERNAL


class BadDataError(SolidcloudError):
    """Scan or archive file with invalid content."""

    code = ErrorCode.CORRUPT
    exit_code = 3


class ScanError(BadDataError):
    """Scan that cannot be read: missing, damaged, empty or of an unknown format."""


class FormatError(BadDataError):
    """Archive that cannot be read: no archive, of another version, truncated or inconsistent."""


class CorruptError(FormatError):
    """Record whose bytes differ from those that were written.

    paths: the files or folders that hold the record, where known.
    """

    def __init__(self, message: str = "", paths: tuple[Path, ...] = ()) -> None:
        """Store the message, which names the files for a human reader, and the paths."""
        super().__init__(message)
        self.paths = paths


class MisleadingIndexError(CorruptError):
    """Record that contradicts the index.

    Queries have already relied on the index for the voxel's identity, the bounds of its points and
    the largest radius class. An index that is wrong about one voxel may be wrong about any voxel
    that has not been read, so no place is known to be clear.
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
    """Return the exception for an error reply with this code.

    An unknown code gives an InternalError; its meaning is never guessed.
    """
    try:
        return _BY_CODE[ErrorCode(code)](message)
    except ValueError:
        known = ", ".join(ErrorCode)
        return InternalError(
            f"error reply with code {code!r}: expected one of {known}: upgrade the client ({message})"
        )
