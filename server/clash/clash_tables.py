"""Clashes as CSV, one row each, and as JSON, with their clusters."""

import csv
import io
import json
import math
from typing import Any

from ...schemas.wire.answers import Verdict
from .clash_check import CheckedPath
from .clash_list import Clash, Cluster

COLUMNS = (
    "clash", "depth_m", "x", "y", "z", "normal_x", "normal_y", "normal_z", "contacts", "clusters",
    "pose_from", "pose_to", "pose_deepest", "t_from", "t_to", "t_deepest", "fraction",
)  # fmt: skip


def clashes_csv(checked: CheckedPath) -> str:
    """Return the clashes as a CSV file, deepest first. Poses are counted from 0.

    A clash between pose 4 and pose 5 has these as its ends, and in `fraction` the place of its
    first contact on that motion; its deepest pose has a number such as 4.4.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    times = checked.track.times
    for number, clash in enumerate(checked.clashes, 1):
        row = [number, clash.depth, *clash.place, *clash.normal, clash.contacts, len(clash.clusters)]
        row += [*checked.poses_of(clash.first, clash.last), _number(checked, clash.deepest)]
        row += [times[place] for place in (clash.first, clash.last, clash.deepest)]
        row.append(checked.fraction(clash))
        writer.writerow([repr(float(each)) if isinstance(each, float) else each for each in row])
    return text.getvalue()


def clashes_json(checked: CheckedPath, **about: str) -> str:
    """Return the clashes as a JSON file. about: names of the scene, the file of poses and so on."""
    content = {
        "about": {**about, "units": {"length": "m", "time": "s"}, "poses_from": 0},
        "poses": len(checked.poses),
        "complete": checked.complete,
        "reach": checked.reach,
        "verdicts": {verdict.name.lower(): checked.count(verdict) for verdict in Verdict},
        "faults": list(checked.faults),
        "motions": {verdict.name.lower(): checked.count_motions(verdict) for verdict in Verdict},
        "least_clearance": checked.clearance,
        "clashes": [clash_values(checked, number, clash) for number, clash in enumerate(checked.clashes, 1)],
        "unknown": [{"poses": list(ends)} for ends in checked.unknown],
    }
    return json.dumps(content, indent=1) + "\n"


def clash_values(checked: CheckedPath, number: int, clash: Clash) -> dict[str, Any]:
    """Return a clash as values for JSON. number: in the list, from 1."""
    return {
        "clash": number,
        "contacts": clash.contacts,
        **_values(checked, clash.clusters[0], clash.first, clash.last),
        "fraction": checked.fraction(clash),
        "clusters": [
            {
                "contacts": each.contacts,
                **_values(checked, each, each.first, each.last),
                "box": [each.low.tolist(), each.high.tolist()],
            }
            for each in clash.clusters
        ],
    }


def _values(checked: CheckedPath, deepest: Cluster, first: int, last: int) -> dict[str, Any]:
    """Return where and when a clash or a cluster is, as values for JSON."""
    times = checked.track.times
    return {
        "depth": deepest.depth,
        "place": deepest.place.tolist(),
        "normal": deepest.normal.tolist(),
        "poses": list(checked.poses_of(first, last)),
        "pose_deepest": _number(checked, deepest.deepest),
        "times": [_finite(times[first]), _finite(times[last])],
        "time_deepest": _finite(times[deepest.deepest]),
    }


def _number(checked: CheckedPath, place: int) -> float | int:
    """Return the number of a pose; one with a fraction between two poses."""
    number = float(checked.track.number[place])
    return int(number) if number.is_integer() else number


def _finite(value: float) -> float | None:
    """Return a number, or None for one that JSON lacks."""
    return float(value) if math.isfinite(value) else None
