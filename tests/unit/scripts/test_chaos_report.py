"""Test that scripts/chaos notices a server's memory or threads that grow, and only those."""

import numpy as np
import pytest
from chaos_cases.chaos_report import GROWTH, _not_held
from chaos_cases.server_restarts import SETTLED_SECONDS, Growth, QuietPoint, fit_growth
from numpy.typing import NDArray

# Ages of a server at the quiet points of a nightly run [s], and the deviation of its memory [MB].
AGES = np.arange(20.0, 400.0, 20.0)
DEVIATION = 0.3


def _growth(megabytes: NDArray[np.float64], avatars: NDArray[np.float64] | float = 0.0) -> Growth:
    """Return the growth of memory at AGES. megabytes: without avatars."""
    held = np.broadcast_to(avatars, AGES.shape)
    found = fit_growth(
        [
            QuietPoint(1, 5000.0 + age, age, {}, {}, int((own + of_avatars) * 1e6), int(of_avatars * 1e6), 1)
            for age, own, of_avatars in zip(AGES, megabytes, held, strict=True)
        ]
    )
    assert found is not None
    return found


@pytest.mark.parametrize("seed", range(20))
def test_a_leak_is_noticed_and_noise_is_not(seed: int) -> None:
    """A leak of 2 MB a minute is beyond the limit; memory that varies is within it, with its interval."""
    noise = np.random.default_rng(seed).normal(0.0, DEVIATION, len(AGES))
    still, leak = _growth(100.0 + noise), _growth(100.0 + noise + 2.0 * AGES / 60)
    assert leak.rate == pytest.approx(still.rate + 2.0, abs=1e-5)
    assert still.low < still.rate < still.high < GROWTH < leak.high


def test_growth_at_the_start_is_no_leak() -> None:
    """Memory that each kind of request takes once does not count."""
    assert _growth(100.0 + 30.0 * np.minimum(AGES / SETTLED_SECONDS, 1.0)).high < 0.01


def test_memory_of_avatars_is_no_leak() -> None:
    """Avatars that the server keeps for a minute do not count."""
    assert _growth(np.full(len(AGES), 100.0), avatars=AGES / 10).high < 0.01


def test_memory_that_varies_too_much_does_not_pass() -> None:
    """A run whose memory varies by tens of MB cannot show that none leaks."""
    varying = 100.0 + 20.0 * (np.arange(len(AGES)) % 2)
    assert _growth(varying).high > GROWTH


def test_too_few_quiet_points_have_no_growth() -> None:
    """Two quiet points have no interval."""
    two = [QuietPoint(1, age, age, {}, {}, 1, 0, 1) for age in (300.0, 320.0)]
    assert fit_growth(two) is None


def test_threads_that_stay_are_noticed_and_a_peak_is_not() -> None:
    """A thread that never ends raises the least number; one that follows the load does not."""

    def judged(*pool: int, own: tuple[int, ...] = (2,) * 6) -> list[str]:
        counts = zip(pool, own, strict=True)
        return _not_held(
            [{"app-0": number, "chaos": workers} for number, workers in counts], [{}] * len(pool)
        )

    assert judged(20, 21, 20, 23, 20, 30) == []
    assert "the least number in the second half" in judged(20, 21, 20, 23, 24, 25)[0]
    assert "'chaos'" in judged(20, 20, 20, 20, 20, 20, own=(2, 2, 2, 2, 2, 3))[0]
