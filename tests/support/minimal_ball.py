"""The judge of tightness: how small a ball around a set of points can be at all. Plain numpy."""

import numpy as np
from numpy.typing import NDArray


def radius_bound(blocks: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lower bounds (b,) on the radius of the minimal ball of each block (b, n, 3), sharp to about 0.1 %.

    Any convex weights w give one: sum(w |p|^2) - |sum(w p)|^2 <= radius^2 (the dual of the minimal ball). So
    the judge is sure whatever the iteration (Frank and Wolfe, steps of 2 / (i + 3)) does on degenerate points.
    """
    p = blocks - blocks.mean(axis=1, keepdims=True)
    squares = (p * p).sum(axis=2)
    weights = np.full(p.shape[:2], 1.0 / p.shape[1])
    rows = np.arange(len(p))
    for step in range(2000):
        centers = np.einsum("bn,bnk->bk", weights, p)
        far = ((p - centers[:, None]) ** 2).sum(axis=2).argmax(axis=1)
        rate = 2.0 / (step + 3.0)
        weights *= 1 - rate
        weights[rows, far] += rate
    centers = np.einsum("bn,bnk->bk", weights, p)
    return np.sqrt(np.maximum((weights * squares).sum(axis=1) - (centers**2).sum(axis=1), 0))
