"""Simulated terrestrial laser scanner: ray casting produces realistic shadows, density and noise.

Each station scans a regular grid of azimuth and elevation with a small jitter and keeps the first
hits. Ranges get normal noise. Where a ray's footprint covers two surfaces at different depths, the
return is mixed: it lies between the two. Returns at grazing incidence are lost. Coordinates are
rounded to the lattice.
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
# Rays per cast: bounds memory (about 300 bytes a ray) and determines which random numbers a ray
# gets.
BLOCK = 1 << 18
# Elevation range [rad]. The cone around the tripod is blind, as with real scanners, and the zenith
# is omitted.
LOWEST, HIGHEST = math.radians(-60.0), math.radians(85.0)
TRIAL_STEP = math.radians(1.0)
# Width of a ray [rad]: divergence and exit spot of a scanner together, 1 cm at 10 m.
FOOTPRINT = 0.001
# Depth steps that give a mixed return [m]. Beyond GAP_HIGH a scanner separates the two returns.
# GAP_LOW is well above the noise, and above the depth range of a footprint at a corner between two
# walls, which is not a step in depth.
GAP_LOW, GAP_HIGH = 0.05, 1.5
GRAZING = 0.12
# A surface seen squarely at FULL_REFLECTION_RANGE has intensity 4095; below NEAR the intensity does
# not grow [m].
FULL_REFLECTION_RANGE, NEAR = 10.0, 2.5


class ScannerPose(NamedTuple):
    """Pose of a scanner: its optical centre [m] and its rotation about z [rad]."""

    position: tuple[float, float, float]
    yaw: float


class SimulatedScan(NamedTuple):
    """Points of one station, in the mesh's frame.

    place, step: the scanner's pose, and the angle between neighbouring rays [rad].
    xyz: (n, 3) float64 [m], on the lattice.
    intensity: (n,) uint16.
    """

    place: ScannerPose
    step: float
    xyz: NDArray[np.float64]
    intensity: NDArray[np.uint16]


class Returns(NamedTuple):
    """First hits of rays (c, e): range [m], inf for no hit; unit directions and normals (c, e, 3)."""

    range: NDArray[np.float64]
    directions: NDArray[np.float64]
    normals: NDArray[np.float64]

    @property
    def cosine(self) -> NDArray[np.float64]:
        """Return the cosine of the angle of incidence (c, e): 1 at perpendicular incidence."""
        cosine: NDArray[np.float64] = np.einsum("cei,cei->ce", self.normals, self.directions)
        return np.abs(cosine)


class RayScene:
    """Mesh prepared for ray casting (embree, float32: 1 um at 20 m, far below the noise)."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        try:
            from embreex.mesh_construction import TriangleMesh
            from embreex.rtcore_scene import EmbreeScene
        except ImportError as error:
            raise SolidcloudError(
                f"cannot cast rays: {error}: generated scenes need embreex: pip install 'solidcloud[scan]'"
            ) from error
        self._scene = EmbreeScene()
        TriangleMesh(self._scene, mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32))

    def cast(
        self, place: ScannerPose, azimuth: NDArray[np.float64], elevation: NDArray[np.float64]
    ) -> Returns:
        """Return the first hits of rays at azimuth (c, e) and elevation (c, e) [rad].

        The azimuth is relative to the yaw.
        """
        around, level = azimuth + place.yaw, np.cos(elevation)
        directions = np.stack([np.cos(around) * level, np.sin(around) * level, np.sin(elevation)], axis=-1)
        flat = directions.reshape(-1, 3).astype(np.float32)
        origins = np.tile(np.asarray(place.position, np.float32), (len(flat), 1))
        hits = self._scene.run(origins, flat, output=1)
        normals = hits["Ng"].astype(np.float64)
        normals /= np.maximum(np.linalg.norm(normals, axis=1), 1e-30)[:, None]
        reach = np.where(hits["primID"] >= 0, hits["tfar"].astype(np.float64), np.inf)
        return Returns(reach.reshape(azimuth.shape), directions, normals.reshape(directions.shape))


def plan_stations(scene: RayScene, places: Sequence[ScannerPose], points: int) -> tuple[float, list[int]]:
    """Return the angular step [rad] for about 3 % more than `points`, and the quota of each station.

    A trial at one degree counts each station's hits; hits grow with 1/step². Every station has the
    same step, as in a real campaign, and quotas are proportional to the hits. The rounding
    remainder goes to the stations with the largest remainders, on a tie to the first.
    """
    trial = np.array([_trial_hits(scene, place) for place in places], np.float64)
    step = TRIAL_STEP * float(np.sqrt(trial.sum() / (1.03 * points)))
    shares = trial / trial.sum() * points
    quotas = np.floor(shares).astype(int)
    left = points - int(quotas.sum())
    quotas[np.argsort(quotas - shares, kind="stable")[:left]] += 1
    return step, quotas.tolist()


def simulate_scan(
    scene: RayScene, place: ScannerPose, step: float, quota: int, key: Sequence[int], *, mixed: bool = True
) -> SimulatedScan:
    """Return exactly `quota` points from one station: one scan, thinned evenly by a seeded choice.

    mixed: with mixed returns; without them, every point is one of a surface.

    A scan with too few points (the plan is based on a trial) is repeated with a step 3 % finer.
    `key` seeds all random numbers: the same key gives the same points.
    """
    while True:
        blocks = list(_blocks(scene, place, step, key, mixed))
        xyz = np.concatenate([block[0] for block in blocks])
        if len(xyz) >= quota:
            break
        step *= 0.97
    rng = np.random.default_rng([*key, 0x7415])
    kept = np.sort(rng.choice(len(xyz), quota, replace=False))
    intensity = np.concatenate([block[1] for block in blocks])
    return SimulatedScan(place, step, xyz[kept], intensity[kept])


def _trial_hits(scene: RayScene, place: ScannerPose) -> int:
    """Count the hits of a grid of one degree whose cosine of incidence is above half of GRAZING."""
    azimuth, elevation = _grid(TRIAL_STEP, 0, int(2 * np.pi / TRIAL_STEP))
    returns = scene.cast(place, azimuth, elevation)
    seen = np.isfinite(returns.range)
    return int((seen & (returns.cosine > GRAZING / 2)).sum())


def _grid(step: float, first: int, last: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return azimuth and elevation (c, e) [rad] of the columns first to last of the regular grid."""
    elevation = np.arange(LOWEST, HIGHEST, step)
    azimuth, elevation = np.meshgrid(np.arange(first, last) * step, elevation, indexing="ij")
    return azimuth, elevation


def _blocks(
    scene: RayScene, place: ScannerPose, step: float, key: Sequence[int], mixed: bool
) -> Iterator[tuple[NDArray[np.float64], NDArray[np.uint16]]]:
    """Yield blocks of returned points (xyz, intensity) of one whole turn, a few columns at a time."""
    columns = int(2 * np.pi / step)
    rows = max(1, int((HIGHEST - LOWEST) / step) + 1)
    wide = max(1, BLOCK // rows)
    for number, first in enumerate(range(0, columns, wide)):
        rng = np.random.default_rng([*key, number])
        azimuth, elevation = _grid(step, first, min(first + wide, columns))
        azimuth += JITTER * step * rng.uniform(-1, 1, azimuth.shape)
        elevation += JITTER * step * rng.uniform(-1, 1, azimuth.shape)
        returns = scene.cast(place, azimuth, elevation)
        # A second ray at a random place on the rim of the footprint detects another surface within
        # it.
        rim = rng.uniform(0, 2 * np.pi, azimuth.shape)
        azimuth += FOOTPRINT / 2 * np.cos(rim) / np.cos(elevation)
        elevation += FOOTPRINT / 2 * np.sin(rim)
        if mixed:
            returns = returns._replace(range=_mixed(returns, scene.cast(place, azimuth, elevation), rng))
        yield _points(place, returns, rng)


def _points(
    place: ScannerPose, returns: Returns, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.uint16]]:
    """Return the points of a block of returns.

    Noise is added, grazing returns are lost, and coordinates are rounded to the lattice.
    """
    reach, cosine = returns.range, returns.cosine
    chance = rng.uniform(size=reach.shape)
    noise = rng.normal(0.0, NOISE, reach.shape)
    # The probability of a return falls linearly from 1 at GRAZING (83 degrees) to 0 at 90 degrees.
    seen = np.isfinite(reach) & (chance * GRAZING <= cosine)
    measured = (reach[seen] + noise[seen])[:, None]
    xyz = np.asarray(place.position) + returns.directions[seen] * measured
    # Detectors damp near returns: strength falls with 1/range, from NEAR on.
    strength = cosine[seen] * (FULL_REFLECTION_RANGE / np.maximum(measured[:, 0], NEAR))
    intensity = np.rint(4095 * strength).astype(np.uint16)
    return np.rint(xyz / LATTICE) * LATTICE, intensity


def _mixed(returns: Returns, rim: Returns, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return ranges (c, e) [m], with mixed returns drawn uniformly between ray and rim.

    A step in depth exists where each of the two hits lies off the other's plane by more than
    GAP_LOW. A difference of ranges alone is no criterion: ranges also differ on one slanting floor.
    At a corner of two walls a hit lies off one plane only, which is no step either.
    """
    seen = np.isfinite(returns.range) & np.isfinite(rim.range)
    here = np.where(seen, returns.range, 0.0)
    gap = np.where(seen, rim.range, 0.0) - here
    between = here[..., None] * (rim.directions - returns.directions) + gap[..., None] * rim.directions
    off = np.minimum(*(np.abs(np.einsum("cei,cei->ce", n, between)) for n in (returns.normals, rim.normals)))
    step = seen & (off > GAP_LOW) & (np.abs(gap) < GAP_HIGH)
    return np.where(step, here + rng.uniform(size=gap.shape) * gap, returns.range)
