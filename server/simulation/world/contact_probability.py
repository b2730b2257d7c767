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
from collections.abc import Iterable, Mapping

# How many standard deviations away a scan is left out, and what it adds to the probability at most.
FARTHEST = 4.0
_ROOT = math.sqrt(2.0)


def contact_probability(gap: float, sigma: float) -> float:
    """Phi(-gap / sigma): that of contact with a scan whose least signed gap is `gap`. sigma > 0; both [m]."""
    return 0.5 * math.erfc(gap / sigma / _ROOT)


LEFT_OUT = contact_probability(FARTHEST, 1.0)


def each_alone(gaps: Mapping[int, float], sigmas: Mapping[int, float]) -> dict[int, float]:
    """The probability of contact with each scan alone, by its number, ascending; those within FARTHEST of its sigma.

    gaps: the least signed gap [m] of scans.  sigmas: [m], of these and perhaps others.
    """
    return {
        number: contact_probability(gaps[number], sigmas[number])
        for number in sorted(gaps)
        if gaps[number] <= FARTHEST * sigmas[number]
    }


def together(alone: Iterable[float]) -> float:
    """The probability of contact with any of several scans that are independent; not below any one's, nor above 1."""
    found = 0.0
    for own in alone:
        found = min(1.0, found + own * (1.0 - found))
    return found
