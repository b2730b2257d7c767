"""Properties of glTF objects, and the bytes that a document uses: what a damaged one would hide."""

from collections.abc import Collection, Sequence
from itertools import accumulate
from typing import Any

# Properties that place vertices, of each kind of object [glTF 2.0, 5]. One of these whose name is
# damaged must not be ignored, which would move or lose vertices.
PROPERTIES = {
    "glTF": {
        *("accessors", "buffers", "bufferViews", "extensionsRequired", "meshes", "nodes", "scene", "scenes"),
    },
    "scenes": {"nodes"},
    "nodes": {"children", "matrix", "mesh", "rotation", "scale", "translation"},
    "meshes": {"primitives"},
    "primitives": {"attributes", "indices", "mode"},
    "accessors": {"bufferView", "byteOffset", "componentType", "count", "type", "sparse"},
    "bufferViews": {"buffer", "byteOffset", "byteLength", "byteStride"},
}
# Bytes of a value by its type, and values in a row by its shape; some matrices have padding more.
SIZES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}


def damaged_names(found: Collection[str], known: Collection[str]) -> list[str]:
    """Return the names of an object that are probably damaged: no words, or a known one but for a letter.

    Only known names that the object lacks count. Programs write properties and attributes of their
    own, which glTF readers ignore.
    """
    missing = set(known) - set(found)
    return [
        name
        for name in found
        if name not in known
        and (
            not (name.isascii() and name.isidentifier())
            or any(
                len(each) == len(name) and sum(a != b for a, b in zip(each, name, strict=True)) == 1
                for each in missing
            )
        )
    ]


def used_bytes(
    accessors: Sequence[dict[str, Any]], views: Sequence[dict[str, Any]]
) -> tuple[list[int], list[int]]:
    """Return the spans of the binary chunk that accessors use, and views without accessors.

    accessors, views: of a document. Returns the first byte of each span, ascending, and the
    greatest end, exclusive, of it and all before it. May raise anything for an invalid document.
    """
    used: list[tuple[int, int]] = []
    free = set(range(len(views)))
    for accessor in accessors:
        if "bufferView" not in accessor:
            continue
        free.discard(accessor["bufferView"])
        view = views[accessor["bufferView"]]
        width = SIZES.get(accessor.get("componentType", 0), 1) * WIDTHS.get(accessor.get("type", ""), 1)
        begin = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        if count := accessor.get("count", 0):
            used.append((begin, begin + (count - 1) * (view.get("byteStride", 0) or width) + width))
    # Pictures, and what extensions use.
    used += [
        (views[k].get("byteOffset", 0), views[k].get("byteOffset", 0) + views[k]["byteLength"]) for k in free
    ]
    used.sort()
    return [begin for begin, _ in used], list(accumulate((end for _, end in used), max))
