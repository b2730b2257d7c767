"""Ideal plan of a walk: a disc that slides along segments without friction. It judges the walks."""

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Length of a step, and distance within which a segment is touched [m].
_STEP, _TOUCH = 1e-3, 2e-3
# Projections of a step; two touched segments need two.
_PROJECTIONS = 8


def disc_paths(segments: Floats, radius: Floats, starts: Floats, ways: Floats, length: float) -> Floats:
    """Return where discs end that are pushed along (k, 2) [m].

    segments: (s, 2, 2).  radius: (k,) of each disc.  starts: (k, 2).  ways: (k, 2) unit, directions
    of the push.  length: sum of all steps [m].
    """
    places = starts.copy()
    low, along = segments[:, 0], segments[:, 1] - segments[:, 0]
    squares = (along**2).sum(axis=1)
    for _ in range(round(length / _STEP)):
        share = np.clip(((places[:, None] - low) * along).sum(axis=2) / squares, 0.0, 1.0)
        out = places[:, None] - (low + share[..., None] * along)
        far = np.linalg.norm(out, axis=2)
        out /= far[..., None]
        touched = far < radius[:, None] + _TOUCH
        step = ways * _STEP
        for _ in range(_PROJECTIONS):
            into = np.where(touched, np.minimum((out * step[:, None]).sum(axis=2), 0.0), 0.0)
            worst = into.argmin(axis=1)
            rows = np.arange(len(places))
            step = step - into[rows, worst, None] * out[rows, worst]
        # Two segments that face each other stop the disc.
        into = np.where(touched, (out * step[:, None]).sum(axis=2), 0.0).min(axis=1)
        step[into < -0.05 * _STEP] = 0.0
        places = places + step
        depth = np.where(touched, radius[:, None] - far, 0.0)
        push = np.where(depth > 0.0, depth, 0.0)[..., None] * out
        places = places + push.sum(axis=1)
    return places
