"""Messages about invalid TOML files, in one sentence: where, what was found, what was expected.

msgspec reports the place (`$.effects[0].skin`) and the type. This module adds the value found
there, everything that is allowed, a suggestion of the valid name, and the line.
"""

import bisect
import difflib
import json
import math
import re
import tomllib
from collections.abc import Iterator
from typing import Any, TypeVar

import msgspec
from msgspec import inspect

from ..errors import BadRequestError
from ..runtime.text_encoding import decode_text

_T = TypeVar("_T")

# Largest file [bytes]. A scene of a thousand objects with poses takes 300 KB.
MAX_BYTES = 4 << 20

_PLACE = re.compile(r" - at `(?:key in )?(\$[^`]*)`$")
_TOKEN = re.compile(r"\.([^.\[]+)|\[(\d+|\.\.\.)\]")
_FIELD = re.compile(r"^Object (contains unknown|missing required) field `([^`]*)`")
_LONGEST_SHOWN = 60
# TOML's integers have 64 bits. Python's are unlimited, and Python refuses to print more than 4,300
# digits.
_MAX_BITS = 63
# Tokens that decide where a statement ends: brackets and line ends. Strings and comments match
# first, so that those inside them do not count.
_MARKS = re.compile(
    r'"""(?:\\.|[^\\])*?"""(?:"{0,2})'
    r"|'''.*?'''(?:'{0,2})"
    r'|"(?:\\.|[^"\\\n])*"'
    r"|'[^'\n]*'|#[^\n]*|[\[\]{}\n]",
    re.DOTALL,
)


def decode(text: bytes, kind: type[_T], where: str) -> _T:
    """Convert a TOML file's bytes to a msgspec type.

    where: the file's name. Raises BadRequestError with one sentence about the first fault.
    """
    data = load(text, where)
    try:
        for place, value in _numbers(data, "$"):
            if isinstance(value, int):
                if value.bit_length() > _MAX_BITS:
                    said = f"found an integer of {value.bit_length():,} bits: expected at most {_MAX_BITS}"
                    raise toml_error(where, place, said, text)
            elif not math.isfinite(value):
                raise toml_error(where, place, f"found {format_value(value)}: expected a finite number", text)
        return msgspec.convert(data, kind)
    except msgspec.ValidationError as error:
        place, said = _explained(str(error), data, kind)
        raise toml_error(where, place, said, text) from None
    except RecursionError:  # dotted keys nest without brackets
        raise BadRequestError(f"{where}: nested too deeply") from None


def load(text: bytes, where: str) -> dict[str, Any]:
    """Parse a TOML file. Raises BadRequestError with line and column."""
    if len(text) > MAX_BYTES:
        raise BadRequestError(f"{where}: more than {MAX_BYTES:,} bytes: expected a scene file")
    try:
        return tomllib.loads(decode_text(text))
    except UnicodeDecodeError as error:
        line = text.count(b"\n", 0, error.start) + 1
        raise BadRequestError(f"{where}: line {line}: bytes that are not UTF-8: save it as UTF-8") from None
    except tomllib.TOMLDecodeError as error:
        raise BadRequestError(f"{where}: not valid TOML: {error}") from None
    except ValueError:
        raise BadRequestError(f"{where}: a number with too many digits") from None
    except RecursionError:
        raise BadRequestError(f"{where}: nested too deeply") from None


def toml_error(where: str, place: str, said: str, text: bytes) -> BadRequestError:
    """Return the error for a fault at a place of a file. text: the file's bytes, to find the line."""
    line = line_of(decode_text(text), place)
    at = f"line {line}: " if line else ""
    return BadRequestError(f"{where}: {at}{place}: {said}")


def format_value(value: Any) -> str:
    """Format a value as in the file, shortened."""
    text = json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= _LONGEST_SHOWN else text[: _LONGEST_SHOWN - 1] + "…"


def suggestion(name: Any, names: list[str]) -> str:
    """Return a hint with the most similar name, or ""."""
    close = difflib.get_close_matches(str(name), names, 1)
    return f": did you mean {format_value(close[0])}?" if close else ""


def line_of(text: str, place: str) -> int | None:
    """Return the line, from 1, of the statement that defines a place in a TOML file.

    Returns None for the whole file, and for a place that it does not contain. The text before any
    statement can be parsed. A place that one prefix defines is defined in every longer prefix, so
    bisection finds the statement.
    """
    tokens = _tokens(place)
    if not tokens or not _has(tomllib.loads(text), tokens):
        return None
    begins = [*_statements(text), len(text)]
    first = bisect.bisect_left(begins, True, key=lambda end: _has(tomllib.loads(text[:end]), tokens))
    return text.count("\n", 0, begins[first - 1]) + 1


def _statements(text: str) -> list[int]:
    """Return the offsets of the lines of a TOML file that begin a statement."""
    begins, depth = [0], 0
    for mark in _MARKS.finditer(text):
        if mark[0] in "[{":
            depth += 1
        elif mark[0] in "]}":
            depth -= 1
        elif mark[0] == "\n" and not depth:
            begins.append(mark.end())
    return begins


def _tokens(place: str) -> list[str | int]:
    """Return the keys and indices of a place, up to a table's value, whose key msgspec omits."""
    steps: list[str | int] = []
    for name, number in _TOKEN.findall(place):
        if number == "...":
            break
        steps.append(name or int(number))
    return steps


def _has(data: Any, tokens: list[str | int]) -> bool:
    """Return True if the data contains the place."""
    for token in tokens:
        try:
            data = data[token]
        except (KeyError, IndexError, TypeError):
            return False
    return True


def _numbers(value: Any, place: str) -> Iterator[tuple[str, int | float]]:
    """Yield all numbers with their places."""
    if isinstance(value, int | float):
        yield place, value
    elif isinstance(value, dict):
        for name, inner in value.items():
            yield from _numbers(inner, f"{place}.{name}")
    elif isinstance(value, list):
        for number, inner in enumerate(value):
            yield from _numbers(inner, f"{place}[{number}]")


def _explained(message: str, data: Any, kind: Any) -> tuple[str, str]:
    """Return the place that a msgspec message is about, and an explanation of the fault."""
    found = _PLACE.search(message)
    place = found[1] if found else "$"
    root = inspect.type_info(kind)
    node, value = _resolve(root, data, _tokens(place))
    field = _FIELD.match(message)
    if not field or not isinstance(node, inspect.StructType):
        return _of_value(place, node, value)
    names = [each.encode_name for each in node.fields]
    if node.tag_field:
        names.insert(0, node.tag_field)
    what = "the file" if place == "$" else f"{_name(node)}" if node.tag_field else "this table"
    if field[1] == "missing required":
        needed = [each.encode_name for each in node.fields if each.required]
        return place, f"has no `{field[2]}`: expected {', '.join(f'`{name}`' for name in needed)}"
    hint = suggestion(field[2], names)
    of_file = [each.encode_name for each in root.fields] if isinstance(root, inspect.StructType) else []
    if not hint and place != "$" and field[2] in of_file:
        # A line after a table's header belongs to that table; the author probably meant a field of
        # the file.
        hint = f": `{field[2]}` of the file itself stands above its first [table]"
    return f"{place}.{field[2]}", f"{what} has no field `{field[2]}`: expected {', '.join(names)}{hint}"


def _of_value(place: str, node: Any, value: Any) -> tuple[str, str]:
    """Explain a fault of a value: return its place and the explanation."""
    if isinstance(node, inspect.UnionType):
        tags = {
            str(_struct(each).tag): each
            for each in node.types
            if isinstance(_struct(each), inspect.StructType)
        }
        if tags:
            field = str(_struct(next(iter(tags.values()))).tag_field)
            return _of_tag(place, field, list(tags), value)
    return place, f"found {format_value(value)}: expected {_expected(node)}"


def _of_tag(place: str, field: str, tags: list[str], value: Any) -> tuple[str, str]:
    """Explain a fault of a tagged table: return its place and the explanation."""
    listed = ", ".join(tags)
    if not isinstance(value, dict):
        hint = (
            f": write [[{place.partition('[')[0][2:]}]] {field} = {format_value(value)}"
            if value in tags
            else ""
        )
        return place, f"found {format_value(value)}: expected a table with `{field}`, one of {listed}{hint}"
    place = place.removesuffix(f".{field}")
    if field not in value:
        return place, f"has no `{field}`: expected one of {listed}"
    tag = value[field]
    return (
        f"{place}.{field}",
        f"{format_value(tag)} is not a known {field}: expected one of {listed}{suggestion(tag, tags)}",
    )


def _resolve(node: Any, value: Any, tokens: list[str | int]) -> tuple[Any, Any]:
    """Return the type and the value at a place.

    For a tagged table, the type is the one that its tag selects. A fault of the tag itself is a
    fault of the table.
    """
    node = _narrowed(node, value)
    for token in tokens:
        node = _struct(node)
        if isinstance(node, inspect.UnionType):
            return node, value
        value = value[token]
        if isinstance(node, inspect.StructType):
            node = next((each.type for each in node.fields if each.encode_name == token), node)
        elif isinstance(node, inspect.TupleType):
            node = node.item_types[int(token)]
        else:
            node = node.item_type
        node = _narrowed(node, value)
    return node, value


def _struct(node: Any) -> Any:
    """Return a type without its metadata."""
    return _struct(node.type) if isinstance(node, inspect.Metadata) else node


def _narrowed(node: Any, value: Any) -> Any:
    """Remove null, which TOML lacks, from a union; select a tagged struct by the value's tag."""
    if not isinstance(node, inspect.UnionType):
        return node
    kinds = [each for each in node.types if not isinstance(each, inspect.NoneType)]
    if len(kinds) == 1:
        return kinds[0]
    if isinstance(value, dict):
        for each in kinds:
            inner = _struct(each)
            if isinstance(inner, inspect.StructType) and value.get(inner.tag_field) == inner.tag:
                return inner
    return inspect.UnionType(tuple(kinds))


def _name(node: inspect.StructType) -> str:
    """Return the name of a tagged table, for messages."""
    return f"{node.tag_field} {format_value(node.tag)}"


def _expected(node: Any) -> str:
    """Describe what a type allows."""
    if isinstance(node, inspect.Metadata):
        said = (node.extra_json_schema or {}).get("description")
        return said or _expected(node.type)
    if isinstance(node, inspect.FloatType | inspect.IntType):
        kind = "an integer" if isinstance(node, inspect.IntType) else "a number"
        return kind + _bounds(node)
    if isinstance(node, inspect.BoolType):
        return "true or false"
    if isinstance(node, inspect.StrType):
        return f"a string{_lengths(node, 'characters')}"
    if isinstance(node, inspect.LiteralType):
        return " or ".join(format_value(value) for value in sorted(node.values, key=str))
    if isinstance(node, inspect.TupleType):
        return f"a list of {len(node.item_types)}, each {_expected(node.item_types[0])}"
    if isinstance(node, inspect.ListType):
        return f"a list{_lengths(node, 'items')}, each {_expected(node.item_type)}"
    if isinstance(node, inspect.DictType):
        return f"a table whose values are each {_expected(node.value_type)}"
    if isinstance(node, inspect.StructType):
        return f"a table of {', '.join(each.encode_name for each in node.fields)}"
    if isinstance(node, inspect.UnionType):
        if tag_field := getattr(_struct(node.types[0]), "tag_field", None):
            return f"a table with `{tag_field}`"
        return " or ".join(dict.fromkeys(_expected(each) for each in node.types))
    return type(node).__name__.removesuffix("Type").lower()


def _bounds(node: inspect.FloatType | inspect.IntType) -> str:
    """Describe the bounds of a number."""
    signs = {"gt": "above", "ge": "from", "lt": "below", "le": "up to"}
    said = [
        f"{word} {bound:,.10g}" for name, word in signs.items() if (bound := getattr(node, name)) is not None
    ]
    return " " + " ".join(said) if said else ""


def _lengths(node: Any, what: str) -> str:
    """Describe the bounds of a length."""
    low, high = node.min_length, node.max_length
    if low is None and high is None:
        return ""
    if low == high:
        return f" of {low} {what}"
    return f" of at least {low or 0} {what}" if high is None else f" of {low or 0} to {high} {what}"
