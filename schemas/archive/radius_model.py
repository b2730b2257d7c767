"""Radius models: they determine the radius of the sphere around each scan point for a query.

`mean` is that of the paper: one radius for all points of a dataset ([Fig12] section 7). `local` and
`border` implement its future work (section 8): radii that follow the spacing around each point, and
smaller radii on the rim of a surface. The archive stores one byte per point for them, the radius
class: the local class in the low four bits, and RIM_BIT if the point is on a rim. A model maps
classes to radii at query time, so one archive serves all models.
"""

import re
from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import BadRequestError
from .units import UNITS_PER_METRE

# Models that `solidcloud build --radius` can store.
STORED_MODELS = ("mean", "local", "border")

LOCAL_CLASSES = 16
RIM_BIT = 16
RADIUS_CLASSES = 32
# Radius of each local class [micrometres]: 1 mm to 32 mm, each 2^(1/3) times the one before, so
# that rounding up adds at most 26 %. The table is the same in every archive, so that a class
# depends only on a point's neighbours. The radii are integers, so that every builder separates two
# classes at exactly the same distance.
LOCAL_RADII = (
    1000, 1260, 1587, 2000, 2520, 3175, 4000, 5040, 6350, 8000, 10079, 12699, 16000, 20159, 25398, 32000
)  # fmt: skip
# Largest radius of a scan point [m]: half of the largest reach of a pair, which is the sum of both
# radii and the margin (server/kernels/core/placed_avatar.py).
MAX_RADIUS = 8.0
# Factor of `border` for the radius of a rim point.
BORDER_SHARE = 0.5

# A number as in JSON, with the decimal point also allowed at either end. Python's float would also
# accept `0_8` for 8, spaces and `nan`.
_NUMBER = re.compile(r"-?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?")

_EXPECTED = (
    "expected mean, local, border or local+border, each with an optional factor (local:0.8), or fixed:METRES"
)


class RadiusModel(NamedTuple):
    """Parsed radius model of a query.

    local, border: the classes that apply.  factor: applied to all radii.
    fixed: one radius for all points [m]; None: stored ones.
    """

    local: bool
    border: bool
    factor: float
    fixed: float | None


def local_radii() -> NDArray[np.float64]:
    """Return the radius (16,) [m] of each local class, ascending."""
    return np.array(LOCAL_RADII) / 1e6


def parse_radius_model(text: str) -> RadiusModel:
    """Parse a radius model: `mean`, `local:0.8`, `local+border`, `fixed:0.01`.

    Raises BadRequestError.
    """
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
    if not 0 <= factor <= MAX_RADIUS:  # false for NaN, too
        raise BadRequestError(f"radius model {text!r}: expected a number from 0 to {MAX_RADIUS}")
    if name == "fixed":
        return RadiusModel(False, False, 1.0, factor)
    return RadiusModel("local" in parts, "border" in parts, factor, None)


def class_radii(text: str | None, radius: float, stored: Collection[str]) -> NDArray[np.int64]:
    """Return the radii of scan points under a model, in exact units.

    The shape is (1,) if all points have the same radius, else (32,), indexed by radius class.
    text: see `parse_radius_model`; None: the archive's single radius.
    radius: that radius [m].  stored: the models that the archive stores.
    A class with a larger local class, or without RIM_BIT, never has a smaller radius. The largest
    local class among some points, with RIM_BIT if all of them have it, therefore gives an upper
    bound of their radii. The archive's single radius is accepted at any size; each pose is checked
    later for the reach that remains.
    Raises BadRequestError for a model that the archive does not store.
    """
    model = RadiusModel(False, False, 1.0, None) if text is None else parse_radius_model(text)
    missing = [name for name in ("local", "border") if getattr(model, name) and name not in stored]
    if missing:
        held = ",".join(name for name in STORED_MODELS if name in stored)
        raise BadRequestError(
            f"radius model {text!r}: this archive stores {held}: choose one of those, "
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


@dataclass(frozen=True, slots=True)
class LocalRadius:
    """Number of points that `local` gives a radius [m]."""

    radius: float
    points: int


@dataclass(frozen=True, slots=True)
class RadiusDistribution:
    """Distribution of an archive's radius classes.

    local: the radii that at least one point has, ascending; empty if `local` is not stored.
    capped: points that had too few neighbours for a local class and have the largest radius.
    rim: points on the rim of a surface.
    None: not stored.
    """

    local: tuple[LocalRadius, ...]
    capped: int | None
    rim: int | None


def radius_distribution(
    models: Collection[str], counts: NDArray[np.int64], capped: int
) -> RadiusDistribution | None:
    """Return the distribution of an archive's radius classes; None without any.

    models, counts (32,), capped: see `Header` in index.py, `models`, `radius_counts` and
    `radius_capped`.
    """
    with_local, with_border = "local" in models, "border" in models
    if not (with_local or with_border):
        return None
    by_class = counts.reshape(2, LOCAL_CLASSES)  # the second row: points on a rim
    local = zip(local_radii().tolist(), by_class.sum(axis=0).tolist(), strict=True)
    return RadiusDistribution(
        tuple(LocalRadius(*held) for held in local if held[1]) if with_local else (),
        capped if with_local else None,
        int(by_class[1].sum()) if with_border else None,
    )
