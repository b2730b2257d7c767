"""What is wrong with a TOML file: where a statement begins, what is no TOML, what a type allows."""

import random

import msgspec
import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.scene.scene_file import parse_scene
from solidcloud.schemas.scene.toml_faults import decode, line_of, load

TOP = 'format = 1\n[[archives]]\npath = "hall"\n'


def refused(text: str) -> str:
    with pytest.raises(BadRequestError) as found:
        parse_scene(text.encode(), "hall.toml")
    return str(found.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            b"format = 1\n[[archives]\n",
            "hall.toml: not valid TOML: Expected ']]' at the end of an array declaration (at l",
        ),
        (b"format = 1\nname =\n", "(at line 2, column 7)"),
        (b"format = 1\nformat = 1\n", "Cannot overwrite a value (at line 2"),
        (b"format = 1\n# \xff\n", "hall.toml: line 2: bytes that are not UTF-8: save it as UTF-8"),
        (b"a = " + b"[" * 100_000, "hall.toml: nested too deeply"),
        (b"#" * ((4 << 20) + 1), "hall.toml: more than 4,194,304 bytes: expected a scene file"),
    ],
)
def test_what_is_no_toml_says_where(text: bytes, said: str) -> None:
    with pytest.raises(BadRequestError) as found:
        parse_scene(text, "hall.toml")
    assert said in str(found.value)


def test_the_line_is_that_where_a_statement_begins_whatever_stands_around_it() -> None:
    before = '# [[effects]]\nname = "hall" # effect = "x"\n\n' + TOP[11:] + "pose = [ # rows\n" + "  # more\n"
    rows = "  [1, 0, 0, 0],\n  [0, 1, 0, 0],\n  [0, 0, 1, 0],\n  [0, 0, 0, 1],\n]\n"
    text = "format = 1\n" + before + rows + '[[effects]]\n"effect" = "stop"\n\n[[effects]]\neffect = "slyde"'
    assert "line 18: $.effects[1].effect" in refused(text)
    crlf = text.replace("\n", "\r\n")
    assert "line 18: $.effects[1].effect" in refused(crlf)


def test_the_line_of_every_place_of_a_file_is_found() -> None:
    rng = random.Random(5)
    for _ in range(20):
        lines: list[str] = []
        expected: dict[str, int] = {}
        for number in range(rng.randint(1, 6)):
            lines += rng.choice([[], ["# a = 1"], ["", "#"]])
            expected[f"$.item[{number}]"] = len(lines) + 1
            lines.append("[[item]]")
            for name in rng.sample("abcdef", rng.randint(0, 4)):
                lines += rng.choice([[], [""], ['# "x"']])
                expected[f"$.item[{number}].{name}"] = len(lines) + 1
                value = (
                    [f"{name} = [", " # [[item]]", " 1,", "]"],
                    [f"{name} = 3"],
                    [f'{name} = """', "[[item]]", '"""'],
                )
                lines += rng.choice(value)
        text = "\n".join(lines)
        assert {place: line_of(text, place) for place in expected} == expected
        assert line_of(text, "$") is None and line_of(text, "$.other") is None


class _Inner(msgspec.Struct, forbid_unknown_fields=True):
    size: int | float = 1
    flag: bool = True


class _Outer(msgspec.Struct):
    inner: _Inner
    names: dict[str, str] = {}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (".".join(["a"] * 5000) + " = 1", "nested too deeply"),
        ("names." + ".".join(["a"] * 5000) + " = 1", "nested too deeply"),
        ("inner = " + "9" * 5000, "a number with too many digits"),
        ("inner = 0x" + "F" * 5000, "line 1: $.inner: found an integer of 20,000 bits: expected at most 63"),
        ("\ufeffinner = 3", "line 1: $.inner: found 3: expected a table of size, flag"),
    ],
)
def test_what_no_editor_writes_is_told_as_well(text: str, said: str) -> None:
    with pytest.raises(BadRequestError) as found:
        decode(text.encode(), _Outer, "x.toml")
    assert str(found.value) == f"x.toml: {said}"


@pytest.mark.parametrize("code", ["utf-8", "utf-8-sig", "utf-16"])
def test_the_text_of_any_editor_is_read(code: str) -> None:
    """Issue 35."""
    assert load("[names]\na = 'ü'\n".encode(code), "x.toml") == {"names": {"a": "ü"}}
