"""What the verbs of the command line have in common: options that several take, sizes, missing libraries, JSON."""

import json
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from ...schemas.errors import BadRequestError, SolidcloudError

ArchivePath = Annotated[Path, typer.Argument(help="Folder of an archive.")]
KeyFile = Annotated[
    Path | None,
    typer.Option(
        help="File with the server's key; left out: the one that a server of this user has left is found."
    ),
]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]


def parse_bytes(text: str, option: str) -> int:
    """A size such as 512MB or 2GB in bytes, in steps of 1024; BadRequestError names the option."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)i?B?", text.strip(), re.IGNORECASE)
    if not match:
        raise BadRequestError(f"{option} {text!r}: expected a size such as 512MB or 2GB")
    return int(float(match[1]) * 1024 ** " KMGT".index(match[2].upper() or " "))


@contextmanager
def needs_extra(name: str) -> Iterator[None]:
    """Say which extra to install where a library of it is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("solidcloud"):
            raise
        raise SolidcloudError(
            f"the library {error.name!r} is not installed: pip install 'solidcloud[{name}]'"
        ) from None


def complain(message: str, code: int) -> int:
    """Print one line on standard error, and one more for each that is indented, as lists are; returns the exit code."""
    print("error: " + re.sub(r"\s*\n(?!  )", " ", message.rstrip()), file=sys.stderr)
    return code


def print_json(value: Any) -> None:
    print(json.dumps(value, indent=1, allow_nan=False))
