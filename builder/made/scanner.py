"""A terrestrial laser scanner, by casting rays: shadows, density and noise come out as they do in the field.

Each station turns a regular grid of azimuth and elevation, jittered a little, and keeps first hits. Then:
ranges get normal noise; at a step in depth between neighbouring rays some returns are mixed, placed between
the two depths; returns at grazing incidence are lost; coordinates are rounded to the lattice of 0.1 mm.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from ...schemas.errors import SolidcloudError

LATTICE = 0.0001
TRIPOD = 1.7
NOISE = 0.002
JITTER = 0.2
# Rays cast at once: bounds memory (about 200 bytes a ray) and fixes which random numbers a ray gets.
BLOCK = 1 << 18
# The tripod's own cone is blind, as with real scanners, and the zenith is left out.
LOWEST, HIGHEST = math.radians(-60.0), math.radians(85.0)
TRIAL_STEP = math.radians(1.0)
# Two surfaces within one footprint give one range between them only where a scanner cannot tell the
# returns apart; beyond GAP_HIGH it can. GAP_LOW is well above the noise.
GAP_LOW, GAP_HIGH = 0.05, 1.5
MIXED_SHARE = 0.2
GRAZING = 0.12
FULL_REFLECTION_RANGE = 10.0


class Place(NamedTuple):
    """Where a scanner stands: its optical centre [m] and its rotation about z [rad]."""

    position: tuple[float, float, float]
    yaw: float


class Scan(NamedTuple):
    """One station's points, the mesh's frame: xyz (n, 3) float64 [m], on the lattice; intensity (n,) uint16.

    place, step: where it was taken from, and the angle between neighbouring rays [rad].
    """

    place: Place
    step: float
    xyz: NDArray[np.float64]
    intensity: NDArray[np.uint16]


class Returns(NamedTuple):
    """First hits of a grid of rays: range (c, e) float64 [m], inf where none; cosine of the incidence."""

    directions: NDArray[np.float64]
    range: NDArray[np.float64]
    cosine: NDArray[np.float64]


class RayScene:
    """A mesh prepared for casting rays (embree, float32: 1 um at 20 m, far below the noise)."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise SolidcloudError(
                f"cannot cast rays: {error}: scenes are made with embreex: pip install 'solidcloud[made]'"
            ) from error
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))

    def cast(self, place: Place, azimuth: NDArray[np.float64], elevation: NDArray[np.float64]) -> Returns:
        """First hits of the rays at azimuth (c, e), counted from the yaw, and elevation (c, e) [rad]."""
        around, level = azimuth + place.yaw, np.cos(elevation)
        directions = np.stack([np.cos(around) * level, np.sin(around) * level, np.sin(elevation)], axis=-1)
        flat = directions.reshape(-1, 3).astype(np.float32)
        origins = np.broadcast_to(np.float32(place.position), flat.shape).copy()
        hits = self._scene.run(origins, flat, output=1)
        normals = hits["Ng"].astype(np.float64)
        lengths = np.linalg.norm(normals, axis=1)
        cosine = np.abs(np.einsum("ij,ij->i", normals, flat)) / np.maximum(lengths, 1e-30)
        reach = np.where(hits["primID"] >= 0, hits["tfar"].astype(np.float64), np.inf)
        return Returns(directions, reach.reshape(azimuth.shape), cosine.reshape(azimuth.shape))


def plan(scene: RayScene, places: Sequence[Place], points: int) -> tuple[float, list[int]]:
    """The angular step [rad] that gives about 3 % more than `points`, and how many each station owes.

    A trial at one degree counts each station's hits; hits grow with 1/step². Every station has the same step,
    as in a real campaign, so shares follow the hits; rounding goes to the largest remainders, then the first.
    """
    trial = np.array([_trial_hits(scene, place) for place in places], np.float64)
    step = TRIAL_STEP * float(np.sqrt(trial.sum() / (1.03 * points)))
    shares = trial / trial.sum() * points
    quotas = np.floor(shares).astype(int)
    left = points - int(quotas.sum())
    quotas[np.argsort(quotas - shares, kind="stable")[:left]] += 1
    return step, quotas.tolist()


def scan(scene: RayScene, place: Place, step: float, quota: int, key: Sequence[int]) -> Scan:
    """Exactly `quota` points from one station: one scan, thinned evenly by a seeded choice.

    A scan that gives too few (the plan is from a trial) is taken again with a step 3 % finer. `key` seeds all
    that is random: the same key gives the same points.
    """
    while True:
        blocks = list(_blocks(scene, place, step, key))
        xyz = np.concatenate([block[0] for block in blocks])
        if len(xyz) >= quota:
            break
        step *= 0.97
    rng = np.random.default_rng([*key, 0x7415])
    kept = np.sort(rng.choice(len(xyz), quota, replace=False))
    intensity = np.concatenate([block[1] for block in blocks])
    return Scan(place, step, xyz[kept], intensity[kept])


def _trial_hits(scene: RayScene, place: Place) -> int:
    """How many rays of a grid of one degree come back, those lost to grazing incidence left out by half."""
    azimuth, elevation = _grid(TRIAL_STEP, 0, int(2 * np.pi / TRIAL_STEP))
    returns = scene.cast(place, azimuth, elevation)
    seen = np.isfinite(returns.range)
    return int((seen & (returns.cosine > GRAZING / 2)).sum())


def _grid(step: float, first: int, last: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Azimuth and elevation (c, e) [rad] of the columns first to last of the regular grid."""
    elevation = np.arange(LOWEST, HIGHEST, step)
    azimuth, elevation = np.meshgrid(np.arange(first, last) * step, elevation, indexing="ij")
    return azimuth, elevation


def _blocks(scene: RayScene, place: Place, step: float, key: Sequence[int]):
    """Blocks of returned points (xyz, intensity) of one whole turn, a few columns at a time."""
    columns = int(2 * np.pi / step)
    rows = max(1, int((HIGHEST - LOWEST) / step) + 1)
    wide = max(1, BLOCK // rows)
    for number, first in enumerate(range(0, columns, wide)):
        rng = np.random.default_rng([*key, number])
        azimuth, elevation = _grid(step, first, min(first + wide, columns))
        jitter = JITTER * step * rng.uniform(-1, 1, (2, *azimuth.shape))
        returns = scene.cast(place, azimuth + jitter[0], elevation + jitter[1])
        yield _points(place, returns, rng)


def _points(
    place: Place, returns: Returns, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.uint16]]:
    """The points of a block of returns: mixed, noisy, grazing ones lost, rounded to the lattice."""
    reach = _mix(returns.range, rng)
    chance = rng.uniform(size=reach.shape)
    noise = rng.normal(0.0, NOISE, reach.shape)
    # The chance to come back falls linearly from 1 at GRAZING (83 degrees) to 0 at 90 degrees.
    seen = np.isfinite(reach) & (chance * GRAZING <= returns.cosine)
    measured = (reach[seen] + noise[seen])[:, None]
    xyz = np.asarray(place.position) + returns.directions[seen] * measured
    strength = (
        returns.cosine[seen]
        * (FULL_REFLECTION_RANGE / np.maximum(measured[:, 0], FULL_REFLECTION_RANGE / 4)) ** 2
    )
    intensity = np.rint(4095 * np.minimum(strength, 16.0)).astype(np.uint16)
    return np.rint(xyz / LATTICE) * LATTICE, intensity


def _mix(reach: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Some ranges at depth edges replaced by one between the two depths, mostly near the ray's own surface.

    The next ray of the same column is the neighbour whose surface shares the footprint.
    """
    share = rng.uniform(size=reach.shape)
    between = rng.uniform(size=reach.shape) ** 3
    following = np.roll(reach, -1, axis=1)
    following[:, -1] = np.inf
    with np.errstate(invalid="ignore"):
        gap = following - reach
        mixed = (share < MIXED_SHARE) & (np.abs(gap) > GAP_LOW) & (np.abs(gap) < GAP_HIGH)
    out = reach.copy()
    out[mixed] += between[mixed] * gap[mixed]
    return out
