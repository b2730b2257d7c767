"""Test the expected costs of settings, from which the remaining time of `solidcloud accuracy` is estimated."""

from solidcloud.builder.config import BuildConfig
from solidcloud.server.report.accuracy.measurement.engine_settings import (
    BUILD_COST,
    POSE_COST,
    compare_costs,
    engine_settings,
    radius_settings,
    time_costs,
)
from solidcloud.server.report.accuracy.measurement.measurement_plan import BRIEF
from solidcloud.server.report.accuracy.measurement.setting_results import BUDGET, DEGREE, TOLERANCE

PLAIN = BuildConfig(resolution=1e-4)
SETTINGS = [*engine_settings(BRIEF, PLAIN, 0.01), *radius_settings(BRIEF, PLAIN, 0.01)]


def test_the_first_setting_of_an_archive_costs_its_build() -> None:
    costs = compare_costs(SETTINGS, PLAIN)
    assert len(costs) == len(SETTINGS) and set(costs) == {1.0, 1.0 + BUILD_COST}
    by_knob = {setting.row.knob: [] for setting in SETTINGS}
    for setting, cost in zip(SETTINGS, costs, strict=True):
        by_knob[setting.row.knob].append(cost)
    assert set(by_knob[TOLERANCE]) == set(by_knob[BUDGET]) == {1.0}, "the archive of the default exists"
    assert by_knob[DEGREE].count(1.0) == 1, "that of the default"
    assert sum(cost > 1 for cost in costs) == len({str(s.config.identity()) for s in SETTINGS}) - 1


def test_a_timed_setting_costs_the_tests_of_its_poses_and_is_timed_once() -> None:
    for number, setting in enumerate(SETTINGS):
        setting.row.node_tests, setting.row.pair_tests = float(number), 1000.0
    costs = time_costs(SETTINGS)
    distinct = {(str(s.config.identity()), str(sorted(s.options.items()))) for s in SETTINGS}
    assert len(costs) == len(distinct) < len(SETTINGS)
    assert costs[:3] == [POSE_COST + 1000 + number for number in range(3)]
