"""Measurement of the radius model `border` on a sheet without thickness with a door.

The figure can only touch the rim of this sheet.
"""

from collections.abc import Callable
from pathlib import Path

from .....builder.config import BuildConfig
from .....builder.pipeline import build_archive
from .....builder.synthetic.sheet import make_sheet
from ....scene import Scene
from ...common.doorway import doorway_error
from ...common.wall_leak import leak
from .accuracy_results import RadiusRow
from .measured_scene import AVATAR

MODELS = ("mean", "border")
FACTORS = (1.0, 2.0, 3.0)
# Spacing of the points [m]: that of a partition or a shop window's frame in a laser scan from a few
# metres.
SPACING = 0.03


def measure_sheet(folder: Path, tick: Callable[[], None]) -> list[RadiusRow]:
    """Measure the sheet of builder/synthetic/sheet.py: doorway error and leak of MODELS with FACTORS.

    Times are not measured here, but on the façade.
    folder: receives the sheet and its archive.  tick: called after each row.
    """
    made = make_sheet(folder / "sheet.ply", spacing=SPACING)
    build_archive(
        [made.path], folder / "sheet", BuildConfig(jobs=1, models=frozenset(MODELS), overwrite=True)
    )
    rows = []
    with Scene.open(folder / "sheet") as scene:
        for model in MODELS:
            for factor in FACTORS:
                name = model if factor == 1.0 else f"{model}:{factor:g}"
                doorway = doorway_error(scene, AVATAR, made.truth, radius_model=name).error
                found = leak(scene, made.places, radius_model=name)
                rows.append(RadiusRow("sheet", model, name, factor, None, doorway, None, *found))
                tick()
    return rows


def count_sheet() -> int:
    """Return the number of rows of `measure_sheet`."""
    return len(MODELS) * len(FACTORS)
