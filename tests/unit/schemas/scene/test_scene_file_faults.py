"""The one clear error of each fault of a scene file: file, line, place, what was found and what is allowed."""

import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.scene.scene_file import parse_scene

TOP = 'format = 1\n[[archives]]\npath = "hall"\n'
EFFECT = TOP + '[[effects]]\neffect = "{}"\n'
STOP = EFFECT.format("stop")
DOOR = '[[avatars]]\nname = "door"\nfile = "door.ply"\n'
NAMES = "stop, sweep, slide, step, ground, proximity, contacts, objects, crowd, through, uncertainty"


def refused(text: str) -> str:
    with pytest.raises(BadRequestError) as found:
        parse_scene(text.encode(), "hall.toml")
    return str(found.value)


FAULTS = {
    # what: text, line (0: none), place, what else is said: found, and what is allowed
    "nothing": ("", 0, "$", ["has no `format`", "expected `format`, `archives`"]),
    "no archive": ("format = 1\narchives = []\n", 2, "$.archives", ["found []", "a list of at least 1 items"]),
    "another format": ("format = 2\n" + TOP[11:], 1, "$.format", ["found 2: expected 1"]),
    "format as text": ('format = "1"\n' + TOP[11:], 1, "$.format", ['found "1": expected 1']),
    "text for a list": ('format = 1\narchives = "hall"\n', 2, "$.archives", ['found "hall"', "expected a list"]),
    "archive without path": ("format = 1\n[[archives]]\n", 2, "$.archives[0]", ["has no `path`: expected `path`"]),
    "empty path": ('format = 1\n[[archives]]\npath = ""\n', 3, "$.archives[0].path", ['found ""', "at least 1 char"]),
    "field of the file": ("format = 1\nnmae = 3\n" + TOP[11:], 2, "$.nmae",
        ["has no field `nmae`", "expected format, archives, name", 'did you mean "name"?']),
    "field of the file in a table": (TOP + "\nlimits = 3\n", 5, "$.archives[0].limits",
        ["has no field `limits`: expected path, pose", "`limits` of the file itself stands above its first [table]"]),
    "a line end in an avatar's name": (TOP + '[[avatars]]\nname = "a\\n"\nfile = "a.ply"\n', 5,
        "$.avatars[0].name", ['found "a\\n"', "1 to 64 of A-Z, a-z, 0-9"]),
    "name": ('format = 1\nname = "a b"\n' + TOP[11:], 2, "$.name", ['found "a b"', "1 to 64 of A-Z, a-z, 0-9"]),
    "name with a line's end": ('format = 1\nname = "ab\\n"\n' + TOP[11:], 2, "$.name", ["1 to 64 of A-Z"]),
    "up of two": ("format = 1\nup = [0, 1]\n" + TOP[11:], 2, "$.up", ["found [0, 1]", "a list of 3, each a number"]),
    "up of text": ('format = 1\nup = [0, 1, "z"]\n' + TOP[11:], 2, "$.up[2]", ['found "z": expected a number']),
    "up of length zero": ("format = 1\nup = [0, 0, 0]\n" + TOP[11:], 2, "$.up", ["[0.0, 0.0, 0.0]", "a direction"]),
    "radius model of no text": ("format = 1\nradius_model = 3\n" + TOP[11:], 2, "$.radius_model",
        ["found 3", "a string"]),
    "radius model": ('format = 1\nradius_model = "big"\n' + TOP[11:], 2, "$.radius_model",
        ["'big'", "expected mean, local, border or local+border"]),
    "pose of one row": (TOP + "pose = [[1, 0, 0, 0]]\n", 4, "$.archives[0].pose",
        ["a list of 4 items, each a list of 4"]),
    "pose of short rows": (TOP + "pose = [\n  [1, 0, 0],\n  [0, 1, 0],\n  [0, 0, 1],\n  [0, 0, 0]]\n", 4,
        "$.archives[0].pose[0]", ["found [1, 0, 0]", "a list of 4 items, each a number"]),
    "pose that scales": (TOP + "pose = [[2, 0, 0, 0], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]\n", 4,
        "$.archives[0].pose", ["not rigid, off by 3:", "of a rotation, within 1e-06, and a translation"]),
    "pose that mirrors": (TOP + "pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]]\n", 4,
        "$.archives[0].pose", ["not rigid, it mirrors:", "of a rotation"]),
    "pose with columns for rows": (TOP + "pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [5, 6, 7, 1]]\n",
        4, "$.archives[0].pose", ["its last row is [5.0, 6.0, 7.0, 1.0]", "last row 0 0 0 1", "row-major"]),
    "pose too far": (TOP + "pose = [[1, 0, 0, 2e9], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n", 4,
        "$.archives[0].pose", ["2000000000.0", "within 1e+09 m"]),
    "pose of an object": (TOP + DOOR + '[[objects]]\nname = "a"\navatar = "door"\n'
        'pose = [[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]\n[[effects]]\neffect = "objects"\n',
        10, "$.objects[0].pose", ["not rigid, off by 1:"]),
    "unknown effect": (EFFECT.format("slid"), 5, "$.effects[0].effect",
        ['"slid" is not a known effect', f"expected one of {NAMES}", 'did you mean "slide"?']),
    "unknown effect like none": (EFFECT.format("xyz"), 5, "$.effects[0].effect",
        [f'"xyz" is not a known effect: expected one of {NAMES}']),
    "effect without a name": (TOP + "[[effects]]\nskin = 1\n", 4, "$.effects[0]", ["has no `effect`", NAMES]),
    "effect that is a number": (TOP + "[[effects]]\neffect = 1\n", 5, "$.effects[0].effect",
        ["1 is not a known effect", NAMES]),
    "effects by names": ('format = 1\neffects = ["stop"]\n' + TOP[11:], 2, "$.effects[0]",
        ['found "stop"', "a table with `effect`", NAMES, 'write [[effects]] effect = "stop"']),
    "effects of text": ('format = 1\neffects = "stop"\n' + TOP[11:], 2, "$.effects",
        ['"stop"', "a list, each a table with `effect`"]),
    "unknown field of an effect": (STOP + '\n# a comment\n[[effects]]\neffect = "step"\nhieght = 0.3\n', 10,
        "$.effects[1].hieght",
        ['effect "step" has no field `hieght`', "expected effect, height", 'did you mean "height"?']),
    "field of another effect": (STOP + "height = 0.3\n", 6, "$.effects[0].height",
        ['effect "stop" has no field', "expected effect, skin"]),
    "text for a length": (STOP + 'skin = "thin"\n', 6, "$.effects[0].skin",
        ['found "thin"', "a number from 0 up to 1"]),
    "negative length": (STOP + "skin = -1\n", 6, "$.effects[0].skin", ["found -1", "a number from 0 up to 1"]),
    "millimetres for metres": (EFFECT.format("step") + "height = 200\n", 6, "$.effects[0].height",
        ["found 200", "above 0 up to 2"]),
    "date for a length": (STOP + "skin = 1979-05-27\n", 6, "$.effects[0].skin", ["1979-05-27", "a number"]),
    "not a number": (STOP + "skin = nan\n", 6, "$.effects[0].skin", ["found NaN", "a finite number"]),
    "infinite": (TOP + "[spawn]\nposition = [0, 0, -inf]\n", 5, "$.spawn.position[2]",
        ["found -Infinity", "a finite number"]),
    "a fraction of a surface": (EFFECT.format("slide") + "surfaces = 1.5\n", 6, "$.effects[0].surfaces",
        ["found 1.5", "an integer from 1 up to 8"]),
    "right angle": (EFFECT.format("ground") + "slope = 90\n", 6, "$.effects[0].slope",
        ["found 90", "from 0 below 90"]),
    "through nothing": (EFFECT.format("through"), 4, "$.effects[0]", ["has no `boxes`: expected `boxes`"]),
    "through no box": (EFFECT.format("through") + "boxes = []\n", 6, "$.effects[0].boxes",
        ["found []", "at least 1 items"]),
    "half a box": (EFFECT.format("through") + '[[effects.boxes]]\nname = "door"\nlow = [0, 0, 0]\n', 6,
        "$.effects[0].boxes[0]", ["has no `high`", "expected `name`, `low`, `high`"]),
    "box the wrong way round": (EFFECT.format("through") +
        '[[effects.boxes]]\nname = "door"\nlow = [0, 0, 0]\nhigh = [1, 1, -1]\n',
        6, "$.effects[0].boxes[0]", ['box "door" from [0.0, 0.0, 0.0] to [1.0, 1.0, -1.0]', "low <= high"]),
    "two boxes of a name": (EFFECT.format("through") + 'boxes = [{name = "d", low = [0, 0, 0], high = [1, 1, 1]}, '
        '{name = "d", low = [0, 0, 0], high = [1, 1, 1]}]\n',
        6, "$.effects[0].boxes[1].name", ['"d" is a duplicate: expected once, as in $.effects[0].boxes[0]']),
    "noise of a scan": (EFFECT.format("uncertainty") + 'scans = {"a.e57" = -1}\n', 6,
        "$.effects[0].scans[...]", ['{"a.e57": -1}', "above 0 up to 1"]),
    "slide without stop": (EFFECT.format("slide"), 4, "$.effects[0]",
        ["`slide` requires `stop`", 'add [[effects]] effect = "stop"', "or leave it out"]),
    "step without what it needs": (STOP + '[[effects]]\neffect = "step"\n', 6, "$.effects[1]",
        ["`step` requires `slide` and `ground`", '[[effects]] effect = "slide" and [[effects]] effect = "ground"']),
    "sweep without stop": (EFFECT.format("sweep"), 4, "$.effects[0]", ["`sweep` requires `stop`"]),
    "ground without stop": (EFFECT.format("ground"), 4, "$.effects[0]", ["`ground` requires `stop`"]),
    "crowd without stop": (EFFECT.format("crowd"), 4, "$.effects[0]", ["`crowd` requires `stop`"]),
    "effect twice": (STOP + '[[effects]]\neffect = "stop"\n', 7, "$.effects[1].effect",
        ['"stop" is a duplicate: expected once, as in $.effects[0]']),
    "avatar twice": (TOP + DOOR + DOOR, 8, "$.avatars[1].name",
        ['"door" is a duplicate: expected once, as in $.avatars[0]']),
    "avatar without a name": (TOP + '[[avatars]]\nname = ""\nfile = "b"\n', 5, "$.avatars[0].name",
        ['found ""', "1 to 64 of A-Z"]),
    "radius of an avatar": (TOP + DOOR + "radius = -0.1\n", 7, "$.avatars[0].radius",
        ["found -0.1", "a number from 0 up to 8"]),
    "object of no avatar": (TOP + DOOR + '[[objects]]\nname = "a"\navatar = "dor"\n', 9,
        "$.objects[0].avatar",
        ['"dor" is not an avatar of the scene: expected one of "door"', 'did you mean "door"?']),
    "object where there are no avatars": (TOP + '[[objects]]\nname = "a"\navatar = "door"\n', 6,
        "$.objects[0].avatar", ['"door" is not an avatar of the scene', "expected it in [[avatars]]"]),
    "object twice": (TOP + DOOR + '[[objects]]\nname = "a"\navatar = "door"\n' * 2
        + '[[effects]]\neffect = "objects"\n',
        11, "$.objects[1].name", ['"a" is a duplicate: expected once, as in $.objects[0]']),
    "object of a kind that is none": (TOP + DOOR + '[[objects]]\nname = "a"\navatar = "door"\nkind = "soft"\n',
        10, "$.objects[0].kind", ['found "soft": expected "kinematic" or "pushed"']),
    "objects without the effect": (TOP + DOOR + '[[objects]]\nname = "a"\navatar = "door"\n', 7, "$.objects",
        ["found 1 without the effect", 'add [[effects]] effect = "objects"', "or leave them out"]),
    "spawn too far": (TOP + "[spawn]\nposition = [0, 0, 1e10]\n", 5, "$.spawn.position",
        ["10000000000.0", "within 1e+09 m"]),
    "spawn that is no table": ("format = 1\nspawn = 3\n" + TOP[11:], 2, "$.spawn",
        ["found 3", "a table of position, heading"]),
    "no users": (TOP + "[limits]\nusers = 0\n", 5, "$.limits.users", ["found 0", "an integer from 1 up to 1,024"]),
    "truth for a number": (TOP + "[limits]\nusers = true\n", 5, "$.limits.users", ["found true", "an integer"]),
    "moves too long": (TOP + "[limits]\nlongest_move = 2000\n", 5, "$.limits.longest_move",
        ["found 2000", "above 0 up to 1,000"]),
}  # fmt: skip


@pytest.mark.parametrize("what", FAULTS)
def test_a_fault_is_one_sentence_with_file_line_place_and_what_is_allowed(what: str) -> None:
    text, line, place, said = FAULTS[what]
    found = refused(text)
    at = f"line {line}: " if line else ""
    assert found.startswith(f"hall.toml: {at}{place}: "), found
    for part in said:
        assert part in found, found
    assert "\n" not in found
