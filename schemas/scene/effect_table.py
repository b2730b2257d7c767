"""Table of the effects that a scene file may declare: options and order.

To add an effect:

1. declare its options here as a class, and add it to `AnyEffect` and `ORDER`;
2. write the function that runs it for a frame, in a file of server/simulation/effects whose function
   `make` returns it, and name the file in server/simulation/simulation.py;
3. describe its options in SCENE.md, and a report, if it adds one to a frame's answer, in WIRE.md.

The parser of scene files, the pipeline of frames, `info` and `solidcloud scene new` read this
table. Bounds of options catch values in other units: a step of 200, a skin of 2.
"""

from typing import Annotated, ClassVar

import msgspec

# Largest reach [m]. Radii and reach together are at most 16 m (WIRE.md); this leaves room for
# radii. It is an integer because Python merges two equal annotations: with a float elsewhere, the
# import order would decide whether the JSON Schema contains 10.0 or 10.
MAX_REACH = 10

# Largest tolerance of frames [m], and the least one of their sweeps: it is far below `skin`, so that
# it never shows.
MAX_TOLERANCE, LEAST_TOLERANCE = 0.1, 1e-5

Length = Annotated[float, msgspec.Meta(ge=0, le=MAX_REACH)]
Near = Annotated[float, msgspec.Meta(gt=0, le=1)]
Degrees = Annotated[float, msgspec.Meta(ge=0, lt=90)]
Vector = tuple[float, float, float]
BoxName = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]


class Effect(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="effect"):
    """Base class of effects.

    needs: effects that this effect requires.
    """

    needs: ClassVar[tuple[str, ...]] = ()


class Stop(Effect, frozen=True, tag="stop"):
    """Contact blocks motion: the avatar stays at the last clear pose.

    skin: distance that the avatar keeps, along its way, from the obstacle that stopped it [m].
    """

    skin: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.002


class Sweep(Effect, frozen=True, tag="sweep"):
    """Continuous motion: the avatar passes through nothing between two frames.

    tolerance: how far any avatar point may move between the last pose known to be clear and the
    first contact [m]; omitted: the file's `tolerance`, at least 1e-5.
    """

    needs: ClassVar[tuple[str, ...]] = ("stop",)
    tolerance: Annotated[float, msgspec.Meta(gt=0, le=MAX_TOLERANCE)] | None = None


class Slide(Effect, frozen=True, tag="slide"):
    """Sliding: the rest of a stopped motion continues along the touched surface.

    surfaces: maximum number of surfaces per frame.
    normal_reach: a surface's normal is estimated from the scan points within this distance of the
    touched point [m].
    """

    needs: ClassVar[tuple[str, ...]] = ("stop",)
    surfaces: Annotated[int, msgspec.Meta(ge=1, le=8)] = 4
    normal_reach: Near = 0.08


class Step(Effect, frozen=True, tag="step"):
    """Climbing: the avatar climbs steps up to a height, and descends them without falling.

    height: of the highest step [m].
    """

    needs: ClassVar[tuple[str, ...]] = ("stop", "slide", "ground")
    height: Annotated[float, msgspec.Meta(gt=0, le=2)] = 0.2


class Ground(Effect, frozen=True, tag="ground"):
    """Gravity: the avatar stands on the ground or falls.

    slope: steeper surfaces are not ground [degrees].
    clearance: height of the feet above the ground, kept within a fifth of it while walking [m].
    snap: ground that lies lower by up to this distance is followed without a fall, at least
    `clearance` [m]; omitted: the height of `step`.
    gravity: [m/s^2].  fall_speed: maximum [m/s].
    """

    needs: ClassVar[tuple[str, ...]] = ("stop",)
    slope: Degrees = 45.0
    clearance: Near = 0.03
    snap: Annotated[float, msgspec.Meta(ge=0, le=2)] | None = None
    gravity: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 9.81
    fall_speed: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 50.0


class Proximity(Effect, frozen=True, tag="proximity"):
    """Report on the nearest scan point in each frame: distance, position and contact normal.

    reach: farthest distance worth reporting [m].
    """

    reach: Annotated[float, msgspec.Meta(gt=0, le=MAX_REACH)] = 0.5


class Contacts(Effect, frozen=True, tag="contacts"):
    """List of contacts and near contacts in each frame, in clusters, deepest first.

    margin: distance below which a pair counts as in contact [m].  limit: maximum number of
    clusters.
    cluster_distance: scan points at most this far apart belong to one cluster [m]; omitted: twice
    the reach of a contact.
    """

    margin: Length = 0.01
    limit: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 16
    cluster_distance: Length | None = None


class Objects(Effect, frozen=True, tag="objects"):
    """Collision with dynamic objects; pushed ones give way as far as the scene allows."""


class Crowd(Effect, frozen=True, tag="crowd"):
    """Collision between users: they do not walk through each other.

    margin: distance that they keep [m].
    """

    needs: ClassVar[tuple[str, ...]] = ("stop",)
    margin: Length = 0.0


class ThroughBox(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Box in which contact is ignored: scan points in it, borders included, are left out.

    low, high: world [m].
    """

    name: BoxName
    low: Vector
    high: Vector


class Through(Effect, frozen=True, tag="through"):
    """Passage through named boxes, for example a door that can be opened, or a portal.

    boxes: scan points in them are left out.
    """

    boxes: Annotated[list[ThroughBox], msgspec.Meta(min_length=1)]


class Uncertainty(Effect, frozen=True, tag="uncertainty"):
    """Report on the probability of contact in each frame, under range noise of the scans.

    sigma: standard deviation of the noise [m].
    scans: standard deviation of individual scans, by the file's name as `info` lists it. An archive
    that does not store the scan of each point (`build --keep scan`) has one sigma for all scans.
    """

    sigma: Near = 0.005
    scans: dict[str, Near] = {}


AnyEffect = (
    Stop | Sweep | Slide | Step | Ground | Proximity | Contacts | Objects | Crowd | Through | Uncertainty
)
# The order in which a frame runs the effects; server/simulation/effects gives the reasons.
# `through`
# is missing: it acts when an archive is opened.
ORDER = (
    "objects", "crowd", "stop", "sweep", "slide", "step", "ground", "proximity", "contacts", "uncertainty",
)  # fmt: skip
# Version of the rules by which effects move an avatar; a log states that of its frames. A change that
# gives other poses from the same motion commands increases it. 2: normals of contacts at edges
# (server/kernels/walk/queries.py). 3: nearly head-on pushes at flat walls, pushed objects on
# floors, and avatars wedged under slopes. 4: motions of avatars in contact, and motion commands
# that last for more than a frame. 5: normals count the points of all voxels.
MOTION_VERSION = 5


def effect_name(effect: AnyEffect) -> str:
    """Return the name of an effect in the file and in answers."""
    return str(type(effect).__struct_config__.tag)
