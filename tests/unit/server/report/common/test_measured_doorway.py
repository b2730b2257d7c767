"""Test the narrowest generated door: the bisection, and which doors the figure passes."""

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import archive_cases
import numpy as np
import pytest
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.synthetic.figure import figure_points
from solidcloud.builder.synthetic.truth import DoorTruth, FacadeTruth
from solidcloud.server.report.common import measured_doorway
from solidcloud.server.report.common.measured_doorway import (
    FINEST,
    WIDEST,
    GeneratedDoor,
    measure_doorways,
    passes,
)
from solidcloud.server.scene import Scene


class Facades:
    """Replacement for the generator: records the widths, and passes doors wide enough for the model."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, narrowest: dict[str, float]) -> None:
        self.widths: list[float] = []
        self.closed = 0
        monkeypatch.setattr(measured_doorway, "_make", self.make)
        monkeypatch.setattr(measured_doorway, "passes", lambda door, model: door.truth >= narrowest[model])

    def make(self, folder: Path, config: BuildConfig, width: float, points: int, seed: int) -> Any:
        """Return a façade whose ground truth is its door's width."""
        self.widths.append(width)
        scene = SimpleNamespace(
            close=self.close, add_avatar=lambda name, points: SimpleNamespace(radius=0.01)
        )
        return GeneratedDoor(scene, width)  # type: ignore[arg-type]

    def close(self) -> None:
        """Count a closed scene."""
        self.closed += 1


def test_narrowest_is_found_to_half_a_millimetre_and_facades_are_made_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    narrowest = {"mean": 0.5543, "local": 0.5551, "fixed:1": 2.0}
    facades = Facades(monkeypatch, narrowest)
    ticks: list[None] = []
    found = measure_doorways(tmp_path, BuildConfig(), list(narrowest), tick=lambda: ticks.append(None))
    for model in ("mean", "local"):
        assert narrowest[model] <= found[model].narrowest <= narrowest[model] + FINEST
    assert math.isinf(found["fixed:1"].narrowest) and math.isinf(found["fixed:1"].error)
    own = np.ptp(figure_points()[:, 0]) + 0.02
    assert found["mean"].width == pytest.approx(own, abs=1e-12)
    assert found["mean"].error == pytest.approx(1000 * (found["mean"].narrowest - own), abs=1e-9)
    assert len(facades.widths) == len(set(facades.widths)) == len(ticks) == facades.closed
    # Twelve façades for the first model; the second model differs within the last three.
    assert len(facades.widths) <= 12 + 3
    assert facades.widths[0] == WIDEST


def test_figure_passes_what_is_clear_at_half_of_the_heights(tmp_path: Path) -> None:
    """Test two jambs 0.7 m apart, with a bolt across at the height of the head.

    The bolt stops the figure at half of the sole heights, then at all.
    """
    frame = DoorTruth("main", -0.35, 0.35, 0.0, 0.1, 0.0, 2.6, 2.9)
    truth = FacadeTruth(1, (0.0, 0.0, 0.0), 0.0, (frame,), (), (), ())
    y, z = np.meshgrid(np.arange(0.0, 0.1, 0.02), np.arange(0.0, 2.6, 0.02), indexing="ij")
    jambs = [np.column_stack([np.full(y.size, x), y.ravel(), z.ravel()]) for x in (-0.35, 0.35)]
    along = np.arange(-0.34, 0.35, 0.01)

    def bolted(height: float | None) -> bool:
        """Return whether the figure passes with a bolt at this height; None: without a bolt."""
        bolt = [] if height is None else [np.column_stack([along, 0 * along + 0.05, 0 * along + height])]
        archive = archive_cases.build(tmp_path, np.concatenate(jambs + bolt), voxel=8.0).archive
        with Scene.open(archive) as scene:
            scene.add_avatar(measured_doorway.AVATAR, figure_points())
            return passes(GeneratedDoor(scene, truth), "mean")

    lifts = measured_doorway.SOLE_HEIGHTS
    tall = figure_points()[:, 2].max()
    middle = tall + (lifts[1] + lifts[2]) / 2
    assert bolted(None)
    assert bolted(middle)
    assert not bolted(tall)
