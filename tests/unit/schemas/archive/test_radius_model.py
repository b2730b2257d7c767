"""Test the names of radius models, and the radii of their classes."""

import numpy as np
import pytest
from solidcloud.schemas.archive.radius_model import (
    BORDER_SHARE,
    LOCAL_CLASSES,
    LOCAL_RADII,
    MAX_RADIUS,
    RADIUS_CLASSES,
    RIM_BIT,
    RadiusModel,
    class_radii,
    local_radii,
    parse_radius_model,
)
from solidcloud.schemas.archive.units import UNITS_PER_METRE
from solidcloud.schemas.errors import BadRequestError

ALL = ("mean", "local", "border")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("mean", RadiusModel(False, False, 1.0, None)),
        ("mean:2", RadiusModel(False, False, 2.0, None)),
        ("local:0.8", RadiusModel(True, False, 0.8, None)),
        ("border", RadiusModel(False, True, 1.0, None)),
        ("local+border:1e-1", RadiusModel(True, True, 0.1, None)),
        ("border+local", RadiusModel(True, True, 1.0, None)),
        ("fixed:0", RadiusModel(False, False, 1.0, 0.0)),
        ("fixed:0.013", RadiusModel(False, False, 1.0, 0.013)),
        ("fixed:1.3e-05", RadiusModel(False, False, 1.0, 1.3e-05)),
        ("local:.5", RadiusModel(True, False, 0.5, None)),
        ("local:2.", RadiusModel(True, False, 2.0, None)),
    ],
)
def test_models_have_names(text: str, expected: RadiusModel) -> None:
    assert parse_radius_model(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "", "Mean", "fixed", "fixed:", "fixed:x", "fixed:-1", "fixed:9", "fixed:nan", "local:", "local:inf", "local+",
        "local+local", "mean+local", "fixed+border:1", "local:1:2", "border ", "local,border", "local:0_8",
        "local: 0.8", "local:0.8 ", "fixed:.", "fixed:1e", "local:٢",
    ],
)  # fmt: skip
def test_what_is_none_is_refused(text: str) -> None:
    with pytest.raises(BadRequestError, match="radius model"):
        parse_radius_model(text)


def test_the_ladder_doubles_every_third_class() -> None:
    radii = local_radii()
    assert len(radii) == LOCAL_CLASSES
    assert (radii[::3] == [0.001, 0.002, 0.004, 0.008, 0.016, 0.032]).all()
    assert np.allclose(radii, 0.001 * np.cbrt(2.0) ** np.arange(16), rtol=0, atol=0.5e-6)


def test_radii_by_class() -> None:
    local = class_radii("local:2", 0.5, ALL)
    border = class_radii("border", 0.5, ALL)
    both = class_radii("local+border", 0.5, ALL)
    for c in range(RADIUS_CLASSES):
        own = LOCAL_RADII[c % LOCAL_CLASSES] * 1e-6
        share = BORDER_SHARE if c & RIM_BIT else 1.0
        assert abs(local[c] - 2 * own * UNITS_PER_METRE) <= 1
        assert border[c] == round(0.5 * share * UNITS_PER_METRE)
        assert abs(both[c] - own * share * UNITS_PER_METRE) <= 1


@pytest.mark.parametrize("text", ["local", "local:3", "border", "border:0", "local+border"])
def test_the_class_of_some_points_together_stands_for_the_largest_of_their_radii(text: str) -> None:
    radii = class_radii(text, 0.02, ALL)
    for a in range(RADIUS_CLASSES):
        for b in range(RADIUS_CLASSES):
            together = max(a % LOCAL_CLASSES, b % LOCAL_CLASSES) | (a & b & RIM_BIT)
            assert radii[together] >= max(radii[a], radii[b])


def test_what_the_archive_does_not_hold_is_refused() -> None:
    with pytest.raises(BadRequestError, match=r"stores mean: .* --radius mean,local"):
        class_radii("local", 0.01, ("mean",))
    with pytest.raises(BadRequestError, match=r"stores mean,local: .* --radius mean,local,border"):
        class_radii("local+border", 0.01, ("mean", "local"))
    with pytest.raises(BadRequestError, match=r"stores mean: .* --radius mean,local,border$"):
        class_radii("border+local", 0.01, ("mean",))
    with pytest.raises(BadRequestError, match="at most"):
        class_radii("mean:8", 1.5, ("mean",))
    assert class_radii("mean:8", 1.0, ("mean",)).tolist() == [round(MAX_RADIUS * UNITS_PER_METRE)]
