"""Radius models: how large a sphere a scan point stands for, and which of them a question asks for.

`mean` is the paper's: one figure for all points of a dataset ([Fig12] section 7). `local` and `border` are its future
work (section 8): spheres after the spacing around each point, and smaller ones on the rim of a surface. What they need
is stored as a radius class a point, one byte: the local class in the low four bits, RIM_BIT where the point is on a
rim. A model turns classes into radii only when a question is asked, so one archive serves them all.
"""

import re
from collections.abc import Collection
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import BadRequestError
from .voxel_grid import UNITS_PER_METRE

# What `solidcloud build --radius` can store.
STORED_MODELS = ("mean", "local", "border")

LOCAL_CLASSES = 16
RIM_BIT = 16
RADIUS_CLASSES = 32
# The radius of each local class [micrometres]: 1 mm to 32 mm, each 2^(1/3) of the one before, so that rounding up adds
# 26 % at most. The same ladder in every archive, so that a class depends on a point's neighbours and on nothing else;
# integers, so that every builder draws the same line between two classes.
LOCAL_RADII = (
    1000, 1260, 1587, 2000, 2520, 3175, 4000, 5040, 6350, 8000, 10079, 12699, 16000, 20159, 25398, 32000
)  # fmt: skip
# A pair reaches 16 m at most, both radii and the margin together (server/kernels/placing.py): half of that is a scan
# point's.
MAX_RADIUS = 8.0
# What `border` leaves of a rim point's radius.
BORDER_SHARE = 0.5

# As JSON has it, a point at either end allowed: Python's float also takes `0_8` for 8, spaces and `nan`.
_NUMBER = re.compile(r"-?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")

_EXPECTED = "expected mean, local, border or local+border, each with a factor where wanted (local:0.8), or fixed:METRES"


class RadiusModel(NamedTuple):
    """What a question asks for. local, border: which classes count.  factor: on all radii.

    fixed: one radius for all [m]; None: stored ones.
    """

    local: bool
    border: bool
    factor: float
    fixed: float | None


def local_radii() -> NDArray[np.float64]:
    """The radius (16,) [m] of each local class, ascending."""
    return np.array(LOCAL_RADII) / 1e6


def parse_radius_model(text: str) -> RadiusModel:
    """A radius model from its name: `mean`, `local:0.8`, `local+border`, `fixed:0.01`. Raises BadRequestError."""
    name, colon, number = text.partition(":")
    parts = name.split("+")
    known = {"mean", "fixed"} if len(parts) == 1 else set()
    if len(set(parts)) < len(parts) or not set(parts) <= known | {"local", "border"}:
        raise BadRequestError(f"radius model {text!r}: {_EXPECTED}")
    factor = 1.0
    if colon or name == "fixed":
        if not _NUMBER.fullmatch(number):
            raise BadRequestError(f"radius model {text!r}: {_EXPECTED}")
        factor = float(number)
    if not 0 <= factor <= MAX_RADIUS:  # not so for NaN either
        raise BadRequestError(f"radius model {text!r}: expected a number from 0 to {MAX_RADIUS}")
    if name == "fixed":
        return RadiusModel(False, False, 1.0, factor)
    return RadiusModel("local" in parts, "border" in parts, factor, None)


def class_radii(text: str | None, radius: float, stored: Collection[str]) -> NDArray[np.int64]:
    """The radii of scan points under a model, exact units: (1,) where all have the same, else (32,), by class.

    text: as `parse_radius_model` takes it; None: the archive's one figure.  radius: that figure [m].  stored: the
    models that the archive holds. A class with a larger local class, or without RIM_BIT, never has a smaller radius:
    so the largest local class of some points, with RIM_BIT where all have it, stands for a radius that none of theirs
    exceeds. The figure itself is always one of the radii that may be asked for, however large: which poses that leaves
    room for is told pose by pose. Raises BadRequestError for a model that the archive does not hold.
    """
    model = RadiusModel(False, False, 1.0, None) if text is None else parse_radius_model(text)
    missing = [name for name in ("local", "border") if getattr(model, name) and name not in stored]
    if missing:
        held = ",".join(name for name in STORED_MODELS if name in stored)
        raise BadRequestError(
            f"radius model {text!r}: this archive holds {held}: ask for one of those, "
            f"or build it with --radius {','.join([held, *missing])}"
        )
    metres = np.full(1, radius if model.fixed is None else model.fixed)
    if model.local or model.border:
        classes = np.arange(RADIUS_CLASSES)
        metres = local_radii()[classes % LOCAL_CLASSES] if model.local else np.full(RADIUS_CLASSES, metres[0])
        if model.border:
            metres = np.where(classes & RIM_BIT, metres * BORDER_SHARE, metres)
    metres = metres * model.factor
    if metres.max() > max(MAX_RADIUS, radius):
        raise BadRequestError(
            f"radius model {text!r}: radii up to {metres.max():g} m: expected at most {MAX_RADIUS} m"
        )
    return np.rint(metres * UNITS_PER_METRE).astype(np.int64)
