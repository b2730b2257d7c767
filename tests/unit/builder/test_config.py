"""Options of a build: what is refused by name, and which of them an archive's bytes depend on."""

import pytest
from solidcloud.builder.build_limits import MAX_SHARDS, SHARD_POINTS, shard_points
from solidcloud.builder.config import BuildConfig, parse_radius, parse_rule
from solidcloud.schemas.errors import BadRequestError

WRONG = {
    "--thin 0": {"thin": 0.0},
    "--thin inf": {"thin": float("inf")},
    "--outliers (0.0, 5)": {"outliers": (0.0, 5)},
    "--outliers (0.1, 0)": {"outliers": (0.1, 0)},
    "--moving (nan, 5)": {"moving": (float("nan"), 5)},
    "--scheduler and --cluster": {"scheduler": "tcp://here:8786", "cluster": "local:2"},
    "--cluster local:0": {"cluster": "local:0"},
    "--cluster two": {"cluster": "two"},
}


@pytest.mark.parametrize("name", WRONG)
def test_what_cannot_be_is_refused_by_name(name: str) -> None:
    with pytest.raises(BadRequestError) as caught:
        BuildConfig(**WRONG[name])
    assert str(caught.value).startswith(name)
    assert "expected" in str(caught.value)


def test_rules_are_a_distance_and_a_count() -> None:
    assert parse_rule("0.1,5", "--outliers") == (0.1, 5)
    assert parse_rule(None, "--outliers") is None
    for text in ("0.1", "0.1,5,6", "5,0.1", "a,b", ""):
        with pytest.raises(BadRequestError, match=r"--moving .*expected a distance in metres and a count"):
            parse_rule(text, "--moving")


def test_an_archive_depends_on_filters_and_not_on_who_does_the_work() -> None:
    plain = BuildConfig().identity()
    assert not {"thin", "outliers", "moving"} & set(plain)
    for options in ({"jobs": 3}, {"memory_bytes": 1 << 30}, {"fresh": True}, {"cluster": "local:2"}):
        assert BuildConfig(**options).identity() == plain
    filters = BuildConfig(thin=0.01, outliers=(0.1, 5), moving=(0.25, 2)).identity()
    added = {name: value for name, value in filters.items() if name not in plain}
    assert added == {"thin": 0.01, "outliers": "0.1,5", "moving": "0.25,2"}


@pytest.mark.parametrize("points", [1, 10**6, 10**7, 10**8, 10**9, 10**10, 10**12])
def test_shards_are_many_enough_for_workers_and_few_enough_to_open(points: int) -> None:
    each = shard_points(points)
    assert each >= SHARD_POINTS // 4
    assert 2 * points / each <= MAX_SHARDS + 1
    assert each <= max(SHARD_POINTS, 2 * points // MAX_SHARDS)
    assert points < 10**7 or points / each >= 9


@pytest.mark.parametrize(
    ("text", "radius", "models"),
    [
        ("mean", None, {"mean"}),
        ("mean,local,border", None, {"mean", "local", "border"}),
        ("local", None, {"mean", "local"}),
        ("0.01", 0.01, {"mean"}),
        ("fixed:0.01", 0.01, {"mean"}),
        ("border, fixed:0", 0.0, {"mean", "border"}),
    ],
)
def test_radius_texts(text: str, radius: float | None, models: set[str]) -> None:
    assert parse_radius(text) == (radius, models)
    BuildConfig(radius=radius, models=frozenset(models))


@pytest.mark.parametrize(
    "text", ["", "median", "mean,0.01", "0.01,fixed:0.02", "fixed:", "fixed:x", "local:2", "mean,"]
)
def test_other_radius_texts_are_refused(text: str) -> None:
    with pytest.raises(
        BadRequestError, match=r"--radius .*expected mean, local, border, separated by commas"
    ):
        parse_radius(text)
