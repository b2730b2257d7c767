"""JSON Schemas of all messages of the wire protocol, which WIRE.md documents."""

import inspect
from typing import Any

import msgspec
import numpy as np

from .arrays import ArrayType, array_fields
from .motion_messages import Moved, MoveRequest, State, Wish
from .overview_messages import OverviewAnswer, OverviewRequest
from .path_messages import PathRequest
from .question_table import QUESTIONS, path_questions
from .requests import AddAvatarRequest, Request
from .residency_messages import ResidencyChanges, ResidencyRequest
from .scene_messages import AvatarInfo, ErrorReply, ReloadAnswer, SceneInfo, ScenesAnswer
from .stats import StatsAnswer, StatsRequest
from .tile_messages import TileAnswer, TileRequest, VoxelsAnswer, VoxelsRequest

MESSAGES: tuple[type, ...] = (
    ScenesAnswer,
    SceneInfo,
    AddAvatarRequest,
    AvatarInfo,
    *(kind for question in QUESTIONS.values() for kind in (question.request, question.answers)),
    PathRequest,
    *(question.part for question in path_questions().values()),
    MoveRequest,
    Moved,
    Wish,
    State,
    OverviewRequest,
    OverviewAnswer,
    VoxelsRequest,
    VoxelsAnswer,
    TileRequest,
    TileAnswer,
    ResidencyRequest,
    ResidencyChanges,
    ReloadAnswer,
    StatsRequest,
    StatsAnswer,
    ErrorReply,
)


def json_schemas() -> dict[str, str]:
    """Return the JSON Schema of every message by the name of its type.

    `schemas/json/` holds the same texts.
    """
    texts = {}
    for kind in MESSAGES:
        components = msgspec.json.schema(kind, schema_hook=lambda _: {"type": "array"})
        for definition in components["$defs"].values():
            # Python 3.13 strips a docstring's indentation, earlier versions do not; cleandoc gives
            # the same text on all.
            definition["description"] = inspect.cleandoc(definition["description"])
        properties = components["$defs"][kind.__name__]["properties"]
        for name, of in array_fields(kind).items():
            default: dict[str, Any] = {"default": []} if "default" in properties[name] else {}
            properties[name] = _array_schema(of, nullable=not issubclass(kind, Request)) | default
        text = msgspec.json.format(msgspec.json.encode(components, order="sorted"), indent=2)
        texts[kind.__name__] = text.decode() + "\n"
    return texts


def _array_schema(of: ArrayType, nullable: bool) -> dict[str, Any]:
    """Return the JSON Schema of an array: nested lists, and the bytes per row in MessagePack."""
    dtype, tail, row_bytes = of
    schema: dict[str, Any] = {
        "type": {"f": "number", "u": "integer", "i": "integer", "b": "boolean"}[dtype.kind]
    }
    if dtype.kind == "f" and nullable:
        schema["type"] = ["number", "null"]
    if dtype.kind in "ui":
        schema |= {"minimum": int(np.iinfo(dtype).min), "maximum": int(np.iinfo(dtype).max)}
    for length in reversed(tail):
        schema = {"type": "array", "items": schema, "minItems": length, "maxItems": length}
    note = f"{dtype.name}; in MessagePack a bin, {row_bytes} bytes an item"
    return {"type": "array", "items": schema, "description": note}
