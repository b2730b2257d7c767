"""Classes of the judged poses, by their exact distance from the scan."""

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Name -> signed distance above and up to [m].
CLASSES = {
    "contact": (-math.inf, 0.0),
    "clear by up to 3 cm": (0.0, 0.03),
    "clear by 3 to 10 cm": (0.03, 0.1),
    "clear by 10 to 50 cm": (0.1, 0.5),
    "farther": (0.5, math.inf),
}
# Classes of fewer poses are not measured. The poses of a class are repeated until a call has at
# least CALL, and thinned out if they are more than LONGEST: then a call takes 5 to 50 ms.
FEWEST, CALL, LONGEST = 20, 600, 1200


def class_members(distance: Floats, fewest: int = FEWEST) -> dict[str, NDArray[np.int64]]:
    """Return name -> rows of the poses with signed distances (k,) [m], for each class of at least `fewest`."""
    found = {}
    for name, (low, high) in CLASSES.items():
        members = np.flatnonzero((distance > low) & (distance <= high))
        if len(members) >= fewest:
            found[name] = members
    return found


def timed_poses(poses: Floats) -> Floats:
    """Return the poses (k, 4, 4) of a class, thinned out or repeated for a timed call."""
    thin = poses[:: max(1, -(-len(poses) // LONGEST))]
    return np.ascontiguousarray(np.concatenate([thin] * max(1, -(-CALL // len(thin)))))
