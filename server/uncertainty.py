"""How probable contact is where scans measure ranges with some noise: the mathematics, and what it assumes.

The model
- Each scan s has one error, a normal deviate of mean 0 and standard deviation sigma_s [m]. It is the same for all
  points of the scan that are near the avatar: they were measured one right after another, at like ranges and angles,
  and what is left of a scan's error there is its calibration and its registration, which carry a patch along whole.
  (Noise that is each point's own would make contact surer the denser the scan is, which it does not get in the world.)
- The error goes along the gap of the nearest pair of spheres of that scan. So that pair decides, and the scan touches
  where g_s + error <= 0, g_s being its least signed gap [m]: with probability Phi(-g_s / sigma_s). The range of a scan
  that looked at the surface aslant errs along its ray, and by less along the gap: what is said is then too near 1/2.
- Scans are independent, so P(contact) = 1 - prod_s Phi(g_s / sigma_s).
- The avatar has no error.

What is left out: a scan with g_s > 4 sigma_s. It adds less than LEFT_OUT = 3.2e-5 to the probability, each.

Phi is taken of math.erfc, the C library's: good to some units in the last place in both tails, where 1 - Phi would
cancel. Its last bits may differ between C libraries; on one machine the same gaps give the same bits. Scans are
multiplied in the order of their numbers.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

# How many standard deviations away a scan is left out, and what it adds to the probability at most.
FARTHEST = 4.0
_ROOT = math.sqrt(2.0)


def contact_probability(gap: float, sigma: float) -> float:
    """Phi(-gap / sigma): that of contact with a scan whose least signed gap is `gap`. sigma > 0; both [m]."""
    return 0.5 * math.erfc(gap / sigma / _ROOT)


LEFT_OUT = contact_probability(FARTHEST, 1.0)


class Probable(NamedTuple):
    """That of contact lies between `least` and `most`.  scans: of each scan alone, by its number, ascending."""

    least: float
    most: float
    scans: dict[int, float]

    @property
    def known(self) -> bool:
        """Whether least and most are the same, within what the model leaves out of each scan."""
        return self.most - self.least <= LEFT_OUT


def least_gaps(scans: NDArray[np.int32], gaps: NDArray[np.float64]) -> dict[int, float]:
    """The least signed gap of each scan, by its number, in ascending order.

    scans, gaps: (p,) the scan and the signed gap [m] of pairs, deepest first, as `contacts` lists them.
    """
    numbers, first = np.unique(scans, return_index=True)
    return dict(zip(numbers.tolist(), gaps[first].tolist(), strict=True))


def probable(
    gaps: Mapping[int, float], sigmas: Mapping[int, float], farthest: float | None = None
) -> Probable:
    """The probability of contact.

    gaps: the least signed gap [m] of each scan that was met.  sigmas: [m] of each scan that there is, those met and
    others.  farthest: others are at least so far [m]; None: out of the question.
    """
    alone = {
        number: contact_probability(gaps[number], sigmas[number])
        for number in sorted(gaps)
        if gaps[number] <= FARTHEST * sigmas[number]
    }
    least = 0.0
    for own in alone.values():
        least = _either(least, own)
    most = least
    if farthest is not None:
        for number in sorted(sigmas.keys() - gaps.keys()):
            if farthest <= FARTHEST * sigmas[number]:
                most = _either(most, contact_probability(farthest, sigmas[number]))
    return Probable(least, most, alone)


def _either(one: float, other: float) -> float:
    """The probability of one or the other of two that are independent; not below either, nor above 1."""
    return min(1.0, one + other * (1.0 - one))
