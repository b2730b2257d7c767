"""The probability of contact: against numbers known otherwise, and what bounds it."""

import math
import statistics

import numpy as np
import pytest
from solidcloud.server.simulation.effects.uncertainty_effect import (
    combined_probability,
    contact_probability,
    single_probabilities,
)

# Upper tails of the normal distribution, from tables (Abramowitz and Stegun, table 26.1; 26.2 for the last).
TAILS = {
    0.0: 0.5,
    0.5: 0.308537538726,
    1.0: 0.158655253931,
    2.0: 0.022750131948,
    3.0: 0.001349898032,
    6.0: 9.8659e-10,
}


@pytest.mark.parametrize(("away", "tail"), TAILS.items())
def test_one_scan_has_the_tail_of_the_normal_distribution(away: float, tail: float) -> None:
    for sigma in (0.001, 0.7):
        assert contact_probability(away * sigma, sigma) == pytest.approx(
            tail, rel=1e-4 if tail < 1e-6 else 1e-10
        )
        assert contact_probability(-away * sigma, sigma) == pytest.approx(1 - tail, rel=1e-10)


def test_both_ends_are_zero_and_one_and_nothing_overflows() -> None:
    for sigma in (1e-9, 1e-3, 1.0):
        assert contact_probability(-16.0, sigma) == 1.0 or sigma == 1.0
        assert 0.0 <= contact_probability(16.0, sigma) < 1e-50
    assert contact_probability(-16.0, 1e-300) == 1.0 and contact_probability(16.0, 1e-300) == 0.0
    assert combined_probability(single_probabilities({}, {0: 0.01}).values()) == 0.0


def test_scans_are_independent(rng: np.random.Generator) -> None:
    normal = statistics.NormalDist()
    for _ in range(50):
        sigmas = dict(enumerate(rng.uniform(0.001, 0.05, 6).tolist()))
        gaps = {number: float(sigmas[number] * rng.uniform(-3, 3)) for number in range(5, -1, -1)}
        expected = 1 - math.prod(normal.cdf(gaps[number] / sigmas[number]) for number in gaps)
        alone = single_probabilities(gaps, sigmas)
        assert combined_probability(alone.values()) == pytest.approx(expected, abs=1e-14)
        assert list(alone) == sorted(gaps)
        assert max(alone.values()) <= combined_probability(alone.values()) <= min(1.0, sum(alone.values()))


def test_more_noise_or_less_gap_never_lessens_the_probability_of_what_is_clear(
    rng: np.random.Generator,
) -> None:
    gaps = np.sort(rng.uniform(0, 0.02, 50)).tolist()
    said = [contact_probability(gap, 0.01) for gap in gaps]
    assert said == sorted(said, reverse=True)
    said = [contact_probability(0.01, 0.001 + gap) for gap in gaps]
    assert said == sorted(said)
