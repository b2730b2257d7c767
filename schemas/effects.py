"""The effects a scene may call for, and what each is told: types of the scene file. A tagged union, tag `effect`.

What an effect does is said in server/effects/, one file each; what each default is for, in SCENE.md. Bounds catch what
was meant in other units: a step of 200, a skin of 2.
"""

from typing import Annotated, ClassVar

import msgspec

# A pair reaches 16 m at most, radii and margin or reach together (WIRE.md): what is asked for leaves room for radii.
# An integer: of two equal annotations Python makes one, and 10.0 or 10 would be in the JSON Schema by who comes first.
MOST_REACH = 10

Length = Annotated[float, msgspec.Meta(ge=0, le=MOST_REACH)]
Near = Annotated[float, msgspec.Meta(gt=0, le=1)]
Degrees = Annotated[float, msgspec.Meta(ge=0, lt=90)]
Vector = tuple[float, float, float]
BoxName = Annotated[str, msgspec.Meta(min_length=1, max_length=64)]


class Effect(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="effect"):
    """One effect. needs: effects without which it means nothing."""

    needs: ClassVar[tuple[str, ...]] = ()


class Stop(Effect, frozen=True, tag="stop"):
    """What is touched blocks: the avatar stays at the last clear pose.

    skin: how far from what stopped it, along its way, it stays [m].
    """

    skin: Annotated[float, msgspec.Meta(ge=0, le=1)] = 0.002


class Sweep(Effect, frozen=True, tag="sweep"):
    """Motion is continuous: nothing is passed through between two frames.

    tolerance: how far any avatar point may go between the last clear moment known and the first touch [m].
    """

    needs: ClassVar[tuple[str, ...]] = ("stop",)
    tolerance: Annotated[float, msgspec.Meta(gt=0, le=0.1)] = 1e-5


class Slide(Effect, frozen=True, tag="slide"):
    """What is left of a stopped motion goes along the surface touched.

    surfaces: at most so many are slid along in a frame.  normal_reach: a surface's normal is that of the scan points
    so near the one touched [m].
    """

    needs: ClassVar[tuple[str, ...]] = ("stop",)
    surfaces: Annotated[int, msgspec.Meta(ge=1, le=8)] = 4
    normal_reach: Near = 0.08


class Step(Effect, frozen=True, tag="step"):
    """What is no higher is climbed, and descended without a fall.

    height: of the highest step [m].
    """

    needs: ClassVar[tuple[str, ...]] = ("stop", "slide", "ground")
    height: Annotated[float, msgspec.Meta(gt=0, le=2)] = 0.2


class Ground(Effect, frozen=True, tag="ground"):
    """Gravity: feet on the ground, or falling.

    slope: what is steeper is no ground [degrees].  clearance: feet are held so far above what they stand on, walking
    within a fifth of it [m].  gravity: [m/s^2].  fall_speed: at most [m/s].
    """

    needs: ClassVar[tuple[str, ...]] = ("stop",)
    slope: Degrees = 45.0
    clearance: Near = 0.03
    gravity: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 9.81
    fall_speed: Annotated[float, msgspec.Meta(gt=0, le=1000)] = 50.0


class Proximity(Effect, frozen=True, tag="proximity"):
    """Each frame says how near the nearest point is, where, and the way out.

    reach: farthest worth saying [m].
    """

    reach: Annotated[float, msgspec.Meta(gt=0, le=MOST_REACH)] = 0.5


class Contacts(Effect, frozen=True, tag="contacts"):
    """Each frame lists what is touched, or nearly, in clusters, deepest first.

    margin: what is so near counts as touched [m].  limit: clusters listed, at most.  cluster_distance: scan points so
    far apart at most are of one cluster [m]; left out: twice the reach of a contact.
    """

    margin: Length = 0.01
    limit: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 16
    cluster_distance: Length | None = None


class Objects(Effect, frozen=True, tag="objects"):
    """The scene's dynamic objects block avatars; those that can be pushed give way as far as the scene lets them."""


class Crowd(Effect, frozen=True, tag="crowd"):
    """Users do not walk through one another.

    margin: they stay so far apart [m].
    """

    needs: ClassVar[tuple[str, ...]] = ("stop",)
    margin: Length = 0.0


class ThroughBox(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A box where contact is ignored: scan points in it, borders included, are left out. low, high: world [m]."""

    name: BoxName
    low: Vector
    high: Vector


class Through(Effect, frozen=True, tag="through"):
    """Named boxes are passed: a door known to open, a portal.

    boxes: scan points in them are left out.
    """

    boxes: Annotated[list[ThroughBox], msgspec.Meta(min_length=1)]


class Uncertainty(Effect, frozen=True, tag="uncertainty"):
    """Each frame says how probable contact is, scans measuring ranges with some noise.

    sigma: its standard deviation [m].  scans: that of some scans, by the file's name as `info` lists it.  An archive
    that does not keep the scan of each point (`build --keep scan`) has one sigma.
    """

    sigma: Near = 0.005
    scans: dict[str, Near] = {}


AnyEffect = (
    Stop | Sweep | Slide | Step | Ground | Proximity | Contacts | Objects | Crowd | Through | Uncertainty
)
