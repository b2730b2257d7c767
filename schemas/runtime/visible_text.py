"""Text of others for terminals and XML: characters that hide or move text become escapes."""

import re
import sys
from collections.abc import Iterable
from contextlib import suppress
from typing import Any

# Characters that move the cursor, colour or hide text on a terminal (controls but line feed and
# tab, DEL), turn its direction (bidirectional marks, embeddings, overrides, isolates), or that
# UTF-8 or XML 1.0 does not have (surrogates, which stand for undecodable bytes of file names;
# U+FFFE, U+FFFF).
_HIDDEN = re.compile(
    "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u202a-\u202e\u2066-\u2069\ud800-\udfff\ufffe\uffff]"
)


def visible(text: str) -> str:
    r"""Replace characters that a terminal obeys, hides or lacks by escapes such as `\x1b` and `\u202e`."""
    return _HIDDEN.sub(_escape, text)


def _escape(found: re.Match[str]) -> str:
    code = ord(found[0])
    return f"\\x{code:02x}" if code < 0x100 else f"\\u{code:04x}"


class VisibleStream:
    """Text stream that writes everything through `visible`; otherwise the stream that it wraps."""

    def __init__(self, stream: Any) -> None:
        """Wrap a stream. Characters that its encoding lacks are written as escapes, too."""
        self._stream = stream
        with suppress(AttributeError):
            stream.reconfigure(errors="backslashreplace")

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text, and return its length."""
        self._stream.write(visible(text))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        """Write some texts."""
        for line in lines:
            self.write(line)

    @property
    def rich_proxied_file(self) -> Any:
        """Return the stream to which rich writes its own escape sequences."""
        return getattr(self._stream, "rich_proxied_file", self._stream)


def show_all_output() -> None:
    """Let this process write to standard output and standard error through `visible` from now on."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and not isinstance(stream, VisibleStream):
            setattr(sys, name, VisibleStream(stream))
