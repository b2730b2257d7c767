"""Test the JSON Schemas in schemas/json against the types of the messages."""

import json
from pathlib import Path

from solidcloud.schemas.scene.scene_file import json_schema
from solidcloud.schemas.wire import json_schemas

SCHEMAS = Path(json_schemas.__file__).parents[1] / "json"


def test_schemas_on_disk_are_current():
    expected = {**json_schemas.json_schemas(), "Scene": json_schema()}
    found = {path.stem: path.read_text() for path in SCHEMAS.glob("*.json")}
    assert found == expected, "run scripts/make_schemas"


def test_schema_of_an_array_says_its_shape():
    schema = json.loads(json_schemas.json_schemas()["CollideRequest"])["$defs"]["CollideRequest"]
    row = schema["properties"]["poses"]["items"]["items"]
    assert (row["minItems"], row["maxItems"], row["items"]["type"]) == (4, 4, "number")
    assert schema["additionalProperties"] is False
