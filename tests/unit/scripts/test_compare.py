"""Test scripts/compare: confidence intervals of ratios, and their comparison with a limit."""

import numpy as np
import pytest
from project_scripts import load_script


@pytest.fixture(scope="module")
def compare():
    return load_script("compare")


def test_interval_of_equal_ratios_is_that_ratio(compare):
    assert compare.interval([1.02] * 20) == pytest.approx((1.02, 1.02, 1.02))


def test_interval_holds_the_true_ratio_about_95_times_of_100(compare):
    rng = np.random.default_rng(2012)
    held = 0
    for _ in range(400):
        _, low, high = compare.interval(list(np.exp(rng.normal(np.log(1.1), 0.05, 20))))
        held += low <= 1.1 <= high
    assert 0.91 <= held / 400 <= 0.985


def test_interval_across_the_limit_is_undecided(compare):
    assert compare.word(0.98, 1.04, 1.05) == "within"
    assert compare.word(1.03, 1.07, 1.05) == "undecided"
    assert compare.word(1.06, 1.07, 1.05) == "over"
