"""Build options, with the reason for each default."""

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..schemas.archive.radius_model import MAX_RADIUS, STORED_MODELS
from ..schemas.archive.voxel import MAX_DEGREE, MAX_LEAF, MIN_DEGREE
from ..schemas.errors import BadRequestError

DEFAULT_VOXEL = 8.0
DEFAULT_CELL_POINTS = 1024
# A cell is built at once: with more points, one part of a dense voxel would exceed --memory.
MAX_CELL_POINTS = 1 << 20
# Columns of the points that a build can keep; the last are those that the scans may have.
SCAN_COLUMNS = ("intensity", "rgb", "classification")
KEPT_COLUMNS = ("scan", *SCAN_COLUMNS)
CELL_KINDS = ("octree", "balanced")


def parse_radius(text: str) -> tuple[float | None, frozenset[str]]:
    """Parse `--radius`, such as `mean,local` or `fixed:0.01,border`.

    Return the stored radius [m], None for the mean, and the set of radius models. A number alone is
    a stored radius. Raise BadRequestError for anything else.
    """
    radius, models = None, {"mean"}
    parts = [part.strip() for part in text.split(",")]
    wrong = f"--radius {text!r}: expected mean, local, border, separated by commas, or fixed:METRES in place of mean"
    for part in parts:
        if part in STORED_MODELS:
            models.add(part)
            continue
        try:
            metres = float(part.removeprefix("fixed:"))
        except ValueError:
            raise BadRequestError(wrong) from None
        if radius is not None or "mean" in parts:
            raise BadRequestError(f"{wrong}: only one radius is stored")
        radius = metres
    return radius, frozenset(models)


def parse_rule(text: str | None, option: str) -> tuple[float, int] | None:
    """Parse `0.1,5` to (0.1, 5), a distance [m] and a count; return None for None.

    Raise BadRequestError for anything else.
    """
    if text is None:
        return None
    try:
        distance, count = text.split(",")
        return float(distance), int(count)
    except ValueError:
        raise BadRequestError(
            f"{option} {text!r}: expected a distance in metres and a count, such as 0.1,5"
        ) from None


def _is_rule(rule: tuple[float, int] | None) -> bool:
    """Return whether `rule` is a valid distance and count, or None."""
    return rule is None or (0 < rule[0] < math.inf and rule[1] >= 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildConfig:
    """Options of a build.

    voxel: edge of a voxel [m], at most 2^21 steps, to which it shrinks. With 8 m, a few to a few
    hundred voxels of a few MB each are in reach of a walk.
    resolution: lattice step [m]; None: the sources' common step if they share one, otherwise 0.1 mm
    or less, by the distance between points (sources/lattice_step.py). 1 mm saves a third of the
    archive and no time, and moves distances by up to 0.7 mm (measured with `solidcloud accuracy`,
    as are the next two).
    degree: children per node, 2 to 16 ([Fig12] table 1 tries 4 to 16). All values from 4 to 16 take
    the same time within 3 %.
    leaf: points per leaf node, up to 32, the width of the vector test. 16 takes 4 % less time, for
    12 % more archive.
    cell_points: an octree cell with more points is split. Octants separate surfaces better than
    packing does: with 1024 instead of 4096, `collide` takes 3 % less time with voxels of 32 m and
    16 % less with voxels of 8 m, for 4 % more memory and 1 % more archive. 256 gains little more,
    for 16 % more memory (scripts/bench_engine --only cells).
    cells: "octree", or "balanced", which also merges cells until all trees have the same height
    (balance_cells.py).
    leaf_cells: requested number of leaf cells of the archive, [Fig12] section 7 has 4,096. A build
    then chooses `cell_points` (passes/cell_size.py). None: `cell_points` as given.
    models: stored radius models: always "mean", optionally "local" and "border", which need one
    byte per point. The default is "mean" alone: a ball of 5 cm enters a surface by 14 mm with
    "local" and by 16 mm with "mean", but "local" takes a seventh more time, and makes doors with
    thinly scanned jambs narrower. "border" pays off only on thin sheets (`solidcloud accuracy`;
    builder/DESIGN.md).
    radius: radius used for `mean` [m]; None: half the mean closest-point distance.
    spacing: meshes are sampled at about this spacing [m]; None: their vertices are used.
    with_slab: bound each node by a sphere cut by a slab; False is the structure of the paper, for
    comparison, five times as slow.
    jobs: number of worker processes; 0: one per core.  memory_bytes: bound on the memory of the
    passes.
    level: also write a level of detail (schemas/archive/level.py).
    keep: extra columns, among KEPT_COLUMNS.
    strict: a point that is not finite, or beyond 1e9 m, fails the build.
    skip_bad: leave out scans that cannot be read and mark their region as unknown.
    overwrite: replace an archive of the same name, once the new one is complete.
    fresh: discard the work of an interrupted build of the same name.
    thin: keep one point per cell of this size [m]; None: keep all.
    outliers: (distance [m], count): leave out points with fewer than `count` other points within
    the distance; None: keep all.
    moving: (distance [m], scans): leave out points that other scans saw through
    (builder/passes/filter_rules.py); None: keep all.
    drop_classes: numbers of classes, and "synthetic" for points with that flag in LAS, to leave
    out.
    scheduler: address of a dask scheduler whose workers do the work.
    cluster: "local:N", a cluster of N workers that is started for the build. If both are None,
    processes on this machine do the work.
    """

    voxel: float = DEFAULT_VOXEL
    resolution: float | None = None
    degree: int = 8
    leaf: int = 32
    cell_points: int = DEFAULT_CELL_POINTS
    cells: str = "octree"
    leaf_cells: int | None = None
    spacing: float | None = None
    radius: float | None = None
    models: frozenset[str] = frozenset({"mean"})
    with_slab: bool = True
    jobs: int = 0
    memory_bytes: int = 2 << 30
    level: bool = True
    keep: frozenset[str] = field(default_factory=frozenset)
    strict: bool = False
    skip_bad: bool = False
    overwrite: bool = False
    fresh: bool = False
    thin: float | None = None
    outliers: tuple[float, int] | None = None
    moving: tuple[float, int] | None = None
    drop_classes: frozenset[int | str] = field(default_factory=frozenset)
    scheduler: str | None = None
    cluster: str | None = None

    def __post_init__(self) -> None:
        """Refuse options outside the range that the format and the kernels support."""
        checks = [
            (
                MIN_DEGREE <= self.degree <= MAX_DEGREE,
                f"--degree {self.degree}",
                f"{MIN_DEGREE} to {MAX_DEGREE}",
            ),
            (1 <= self.leaf <= MAX_LEAF, f"--leaf {self.leaf}", f"1 to {MAX_LEAF}"),
            (self.cell_points >= 1, f"--cell-points {self.cell_points}", "at least 1"),
            (
                self.leaf_cells is None or self.leaf_cells >= 1,
                f"--leaf-cells {self.leaf_cells}",
                "at least 1",
            ),
            (self.cells in CELL_KINDS, f"--cells {self.cells}", " or ".join(CELL_KINDS)),
            (0 < self.voxel < math.inf, f"--voxel {self.voxel}", "a positive length in metres"),
            (
                self.resolution is None or 0 < self.resolution < math.inf,
                f"--resolution {self.resolution}",
                "a positive step",
            ),
            (
                self.spacing is None or 0 < self.spacing < math.inf,
                f"--spacing {self.spacing}",
                "a positive distance",
            ),
            (
                self.radius is None or 0 <= self.radius <= MAX_RADIUS,
                f"--radius {self.radius}",
                f"0 to {MAX_RADIUS} m",
            ),
            (
                {"mean"} <= self.models <= set(STORED_MODELS),
                f"--radius {','.join(sorted(self.models))}",
                "mean, optionally with local and border",
            ),
            (self.jobs >= 0, f"--jobs {self.jobs}", "0 (all cores) or more"),
            (self.memory_bytes >= 64 << 20, f"--memory {self.memory_bytes} bytes", "at least 64MB"),
            (
                self.keep <= set(KEPT_COLUMNS),
                f"--keep {','.join(sorted(self.keep))}",
                f"{', '.join(KEPT_COLUMNS)}, separated by commas",
            ),
            (self.thin is None or 0 < self.thin < math.inf, f"--thin {self.thin}", "a positive distance"),
            (
                _is_rule(self.outliers),
                f"--outliers {self.outliers}",
                "a positive distance and a count, 0.1,5",
            ),
            (_is_rule(self.moving), f"--moving {self.moving}", "a positive distance and a count, 0.1,5"),
            (
                self.scheduler is None or self.cluster is None,
                "--scheduler and --cluster",
                "only one of them: the workers of a running scheduler, or workers that are started",
            ),
            (
                self.cluster is None or re.fullmatch(r"local:[1-9][0-9]{0,3}", self.cluster) is not None,
                f"--cluster {self.cluster}",
                "local:N, N workers",
            ),
        ]
        for good, found, expected in checks:
            if not good:
                raise BadRequestError(f"{found}: expected {expected}")

    @property
    def filter_passes(self) -> int:
        """Return the number of filter passes over all points; 0 if no filter is enabled."""
        return (self.moving is not None or self.outliers is not None) + (self.thin is not None)

    def stored_models(self) -> tuple[str, ...]:
        """Return the stored radius models, in the order of STORED_MODELS."""
        return tuple(name for name in STORED_MODELS if name in self.models)

    def identity(self) -> dict[str, float | int | bool | str | None]:
        """Return the options that the archive's bytes depend on, for the index."""
        return {
            "voxel": self.voxel,
            "resolution": self.resolution,
            "degree": self.degree,
            "leaf": self.leaf,
            "cell_points": self.cell_points,
            "spacing": self.spacing,
            "radius": self.radius,
            "with_slab": self.with_slab,
            "keep": ",".join(sorted(self.keep)),
            # Named only if not the default: archives without it stay byte for byte unchanged.
            **({} if self.cells == "octree" else {"cells": self.cells}),
            **({} if self.leaf_cells is None else {"leaf_cells": self.leaf_cells}),
            **({} if self.models == {"mean"} else {"models": ",".join(self.stored_models())}),
            **({} if self.thin is None else {"thin": self.thin}),
            **({} if self.outliers is None else {"outliers": "{!r},{}".format(*self.outliers)}),
            **({} if self.moving is None else {"moving": "{!r},{}".format(*self.moving)}),
            **(
                {
                    "drop_classes": ",".join(
                        sorted(map(str, self.drop_classes), key=lambda name: (len(name), name))
                    )
                }
                if self.drop_classes
                else {}
            ),
        }

    def is_identity(self, options: Mapping[str, Any]) -> bool:
        """Return whether a build with this configuration gives an archive with these stored options.

        With `leaf_cells`, the stored `cell_points` is the one that the build chose.
        """
        chosen = {} if self.leaf_cells is None else {"cell_points": options.get("cell_points")}
        return {**self.identity(), **chosen} == options
