"""Encoding of the text files that people write: byte order marks, and UTF-16 of Windows."""

import codecs

UTF8_MARK = codecs.BOM_UTF8
_UTF16_MARKS = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def decode_text(data: bytes, errors: str = "strict") -> str:
    """Decode the whole of a small text file: UTF-8, or UTF-16 with its mark; the mark is left out.

    errors: as in bytes.decode(). Raises UnicodeDecodeError by default.
    """
    return data.decode("utf-16" if data.startswith(_UTF16_MARKS) else "utf-8-sig", errors)


def is_utf16(head: bytes) -> bool:
    """Return whether a file that begins with these bytes is text in UTF-16, with its mark or without.

    Without a mark, every second of the first letters is a zero byte.
    """
    zeros = [head[start:16:2].count(0) for start in (0, 1)]
    return head.startswith(_UTF16_MARKS) or (len(head) >= 16 and sorted(zeros) == [0, 8])
