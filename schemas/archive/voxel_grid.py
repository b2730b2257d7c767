"""Conversion between world positions, lattice integers, voxel coordinates and voxel keys.

Only this module converts world metres to integers (NUMERICS.md N1, N2). Three frames:

- world: float64 metres, as the scans give them;
- lattice: int64 steps from the dataset's origin; `Lattice.to_lattice`, `Lattice.to_world`;
- voxel: int32 steps from a voxel's low corner, in [0, voxel_steps).

Voxels are half open, [low, low + voxel_steps), so every lattice point is in exactly one.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import BadRequestError
from ..kernels.morton import morton_decode, morton_encode
from .units import MAX_COORDINATE as MAX_COORDINATE
from .units import MIN_STEP as MIN_STEP
from .units import UNITS_PER_METRE

# Offset added to voxel coordinates before they are interleaved, 21 bits per axis, into a uint64
# key.
KEY_BIAS = 1 << 20

# Morton codes hold 21 bits per axis, so the octree of a larger voxel would map distinct points to
# the same code. Node centres, in voxel steps, must also be exact in float32 for the fast pass of
# server/kernels/collide/collide_poses.py: a voxel and its neighbours within reach stay below 2^24
# steps.
MAX_VOXEL_STEPS = 1 << 21


class Lattice(NamedTuple):
    """Integer lattice of one dataset, divided into voxels.

    origin: (3,) float64 world [m] of lattice point (0, 0, 0).  step: [m].
    voxel_steps: edge of a voxel [steps].
    """

    origin: tuple[float, float, float]
    step: float
    voxel_steps: int

    @property
    def voxel_size(self) -> float:
        """Return the edge of a voxel [m]."""
        return self.voxel_steps * self.step

    @property
    def units_per_step(self) -> float:
        """Return the exact units (2^-26 m) per lattice step; rounded once, here."""
        return self.step * UNITS_PER_METRE

    def to_lattice(self, xyz: NDArray[np.float64]) -> NDArray[np.int64]:
        """Quantise world points (n, 3) [m] to lattice integers (n, 3), half to even."""
        return np.rint((xyz - np.array(self.origin)) / self.step).astype(np.int64)

    def to_world(self, lattice: ArrayLike) -> NDArray[np.float64]:
        """Return the world positions (n, 3) [m] of lattice integers (n, 3)."""
        return np.asarray(lattice, np.int64) * self.step + np.array(self.origin)


def voxel_edge(voxel_size: float, step: float) -> float:
    """Return the edge of a voxel [m]: `voxel_size`, but at most MAX_VOXEL_STEPS steps [m]."""
    return min(voxel_size, MAX_VOXEL_STEPS * step)


def make_lattice(origin: ArrayLike, step: float, voxel_size: float) -> Lattice:
    """Make the lattice whose voxels are `voxel_size` [m], rounded to a whole number of steps.

    A larger voxel than the format can hold shrinks, see `voxel_edge`. origin: (3,), world [m].
    step: [m]. Raises BadRequestError if the format cannot represent step or voxel size.
    """
    if not (np.isfinite(step) and step >= MIN_STEP):
        raise BadRequestError(
            f"lattice step {step!r} m: expected at least {MIN_STEP} m: give a coarser --resolution"
        )
    if not (np.isfinite(voxel_size) and voxel_size > 0):
        raise BadRequestError(
            f"voxel size {voxel_size!r} m: expected a positive length: give another --voxel"
        )
    voxel_steps = round(voxel_edge(voxel_size, step) / step)
    if voxel_steps < 1:
        raise BadRequestError(
            f"a voxel of {voxel_size} m is less than a lattice step of {step} m: give a larger --voxel or a finer "
            "--resolution"
        )
    x, y, z = (float(v) + 0.0 for v in np.asarray(origin, np.float64))  # + 0.0: never store -0.0
    return Lattice((x, y, z), float(step), int(voxel_steps))


def voxel_keys(voxels: NDArray[np.int64]) -> NDArray[np.uint64]:
    """Return the Morton keys (n,) of voxel coordinates (n, 3).

    Raises BadRequestError for a voxel farther than 2^20 voxels from the origin.
    """
    biased = np.asarray(voxels, np.int64) + KEY_BIAS
    if biased.size and (biased.min() < 0 or biased.max() >= 2 * KEY_BIAS):
        raise BadRequestError(
            f"voxel coordinates {voxels.min()} to {voxels.max()}: expected within ±{KEY_BIAS}: "
            "a stray point far from the rest? clean the scan, or give a larger --voxel"
        )
    return morton_encode(biased.astype(np.uint64))


def voxel_coordinates(keys: NDArray[np.uint64]) -> NDArray[np.int64]:
    """Return the voxel coordinates (n, 3) of Morton keys (n,)."""
    return morton_decode(np.asarray(keys, np.uint64)).astype(np.int64) - KEY_BIAS
