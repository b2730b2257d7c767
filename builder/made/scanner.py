"""A terrestrial laser scanner, by casting rays: shadows, density and noise come out as they do in the field.

Each station turns a regular grid of azimuth and elevation, jittered a little, and keeps first hits. Then:
ranges get normal noise; where a ray's footprint covers two surfaces at different depths the return is mixed,
somewhere between the two; returns at grazing incidence are lost; coordinates are rounded to the lattice.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from ...schemas.errors import SolidcloudError

LATTICE = 0.0001
TRIPOD = 1.7
NOISE = 0.002
JITTER = 0.2
# Rays cast at once: bounds memory (about 300 bytes a ray) and fixes which random numbers a ray gets.
BLOCK = 1 << 18
# The tripod's own cone is blind, as with real scanners, and the zenith is left out.
LOWEST, HIGHEST = math.radians(-60.0), math.radians(85.0)
TRIAL_STEP = math.radians(1.0)
# A ray is about this wide [rad]: divergence and the spot at the exit of a scanner together, 1 cm at 10 m.
FOOTPRINT = 0.001
# Two surfaces within one footprint give one range between them only where a scanner cannot tell the
# returns apart; beyond GAP_HIGH it can. GAP_LOW is well above the noise, and above what a corner between two
# walls makes of a footprint, which is no step in depth.
GAP_LOW, GAP_HIGH = 0.05, 1.5
GRAZING = 0.12
# A surface seen squarely at this range has intensity 4095; nearer than NEAR it does not grow [m].
FULL_REFLECTION_RANGE, NEAR = 10.0, 2.5


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
    """First hits of rays (c, e): range [m], inf where none; unit directions and normals (c, e, 3)."""

    range: NDArray[np.float64]
    directions: NDArray[np.float64]
    normals: NDArray[np.float64]

    @property
    def cosine(self) -> NDArray[np.float64]:
        """Cosine of the incidence (c, e): 1 where a surface is met squarely."""
        cosine: NDArray[np.float64] = np.einsum("cei,cei->ce", self.normals, self.directions)
        return np.abs(cosine)


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
        origins = np.tile(np.asarray(place.position, np.float32), (len(flat), 1))
        hits = self._scene.run(origins, flat, output=1)
        normals = hits["Ng"].astype(np.float64)
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-30)[:, None]
        reach = np.where(hits["primID"] >= 0, hits["tfar"].astype(np.float64), np.inf)
        return Returns(reach.reshape(azimuth.shape), directions, normals.reshape(directions.shape))


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


def _blocks(
    scene: RayScene, place: Place, step: float, key: Sequence[int]
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.uint16]]]:
    """Blocks of returned points (xyz, intensity) of one whole turn, a few columns at a time."""
    columns = int(2 * np.pi / step)
    rows = max(1, int((HIGHEST - LOWEST) / step) + 1)
    wide = max(1, BLOCK // rows)
    for number, first in enumerate(range(0, columns, wide)):
        rng = np.random.default_rng([*key, number])
        azimuth, elevation = _grid(step, first, min(first + wide, columns))
        azimuth += JITTER * step * rng.uniform(-1, 1, azimuth.shape)
        elevation += JITTER * step * rng.uniform(-1, 1, azimuth.shape)
        returns = scene.cast(place, azimuth, elevation)
        # A second ray somewhere on the rim of the footprint tells whether another surface shares it.
        rim = rng.uniform(0, 2 * np.pi, azimuth.shape)
        azimuth += FOOTPRINT / 2 * np.cos(rim) / np.cos(elevation)
        elevation += FOOTPRINT / 2 * np.sin(rim)
        reach = _mixed(returns, scene.cast(place, azimuth, elevation), rng)
        yield _points(place, returns._replace(range=reach), rng)


def _points(
    place: Place, returns: Returns, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.uint16]]:
    """The points of a block of returns: noisy, grazing ones lost, rounded to the lattice."""
    reach, cosine = returns.range, returns.cosine
    chance = rng.uniform(size=reach.shape)
    noise = rng.normal(0.0, NOISE, reach.shape)
    # The chance to come back falls linearly from 1 at GRAZING (83 degrees) to 0 at 90 degrees.
    seen = np.isfinite(reach) & (chance * GRAZING <= cosine)
    measured = (reach[seen] + noise[seen])[:, None]
    xyz = np.asarray(place.position) + returns.directions[seen] * measured
    # Near returns are damped, as detectors do: strength falls with 1/range, from NEAR on.
    strength = cosine[seen] * (FULL_REFLECTION_RANGE / np.maximum(measured[:, 0], NEAR))
    intensity = np.rint(4095 * strength).astype(np.uint16)
    return np.rint(xyz / LATTICE) * LATTICE, intensity


def _mixed(returns: Returns, rim: Returns, rng: np.random.Generator) -> NDArray[np.float64]:
    """Ranges (c, e) [m], those of mixed returns drawn evenly between the ray's own surface and its rim's.

    A step in depth is where either hit lies off the other's plane by GAP_LOW: on one slanting floor ranges
    differ too, and around a corner of two walls one hit lies off one plane only.
    """
    seen = np.isfinite(returns.range) & np.isfinite(rim.range)
    here = np.where(seen, returns.range, 0.0)
    gap = np.where(seen, rim.range, 0.0) - here
    between = here[..., None] * (rim.directions - returns.directions) + gap[..., None] * rim.directions
    off = np.minimum(*(np.abs(np.einsum("cei,cei->ce", n, between)) for n in (returns.normals, rim.normals)))
    step = seen & (off > GAP_LOW) & (np.abs(gap) < GAP_HIGH)
    return np.where(step, here + rng.uniform(size=gap.shape) * gap, returns.range)
