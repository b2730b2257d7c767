"""The options of a build, frozen; each default with its reason."""

import math
import re
from dataclasses import dataclass, field

from ..schemas.errors import BadRequestError
from ..schemas.index import MAX_NORMAL_REACH, NORMAL_REACH
from ..schemas.radius_model import MAX_RADIUS, STORED_MODELS
from ..schemas.voxel import MAX_DEGREE, MAX_LEAF, MIN_DEGREE

# Closest-point distances are measured at about this many points; of fewer, at all.
RADIUS_SAMPLE = 1_000_000

# Points in a work unit, one shard, see `shard_points`: large enough that opening a file is noise, small enough that a
# worker that is killed loses a few seconds.
SHARD_POINTS = 1 << 22
# A server opens all shards of an archive, and a process may open 1,024 files on most systems.
MOST_SHARDS = 512

DEFAULT_STEP = 1e-4
CELL_KINDS = ("octree", "balanced")


def shard_points(points: int) -> int:
    """Points in a shard of a dataset of so many: a function of nothing else, or bytes would depend on jobs.

    A quarter of SHARD_POINTS for few, so that two workers have many each, and end at about the same time: 10^7 points
    in 3 shards kept one of them idle for a quarter of the time.
    """
    # Voxels are not cut, so a shard may stay half empty; two that follow each other hold more than this together.
    return max(SHARD_POINTS // 4, min(SHARD_POINTS, points // 64), 2 * points // MOST_SHARDS)


def parse_radius(text: str) -> tuple[float | None, frozenset[str]]:
    """The stored figure [m], None for the mean, and the models of `--radius mean,local` or `fixed:0.01,border`.

    A number alone is a figure. Raises BadRequestError for anything else.
    """
    radius, models = None, {"mean"}
    parts = [part.strip() for part in text.split(",")]
    wrong = f"--radius {text!r}: expected mean, local, border by comma, or fixed:METRES in place of mean"
    for part in parts:
        if part in STORED_MODELS:
            models.add(part)
            continue
        try:
            metres = float(part.removeprefix("fixed:"))
        except ValueError:
            raise BadRequestError(wrong) from None
        if radius is not None or "mean" in parts:
            raise BadRequestError(f"{wrong}: one figure is stored")
        radius = metres
    return radius, frozenset(models)


def parse_rule(text: str | None, option: str) -> tuple[float, int] | None:
    """`0.1,5` -> (0.1, 5), a distance [m] and a count; None for None. Raises BadRequestError for anything else."""
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
    """Whether this is a distance and a count, or None."""
    return rule is None or (0 < rule[0] < math.inf and rule[1] >= 1)


@dataclass(frozen=True, slots=True, kw_only=True)
class BuildConfig:
    """How an archive is built.

    voxel: edge of a voxel [m]; 8: a few to a few hundred in reach of a walk, a few MB each.
    resolution: lattice step [m]; None: the sources' own where all share one, else 0.1 mm, a twentieth of
    a terrestrial scanner's range noise: 1 mm saves a third of the archive and no time, and moves distances by up to
    0.7 mm (`solidcloud accuracy`, as the next two).
    degree: children a node, 2 to 16 ([Fig12] table 1 tries 4 to 16); 8: all of 4 to 16 take the same time within 3 %.
    leaf: points a leaf node, up to 32, the width of the vector test: 16 takes 4 % less time, for 12 % more archive.
    cell_points: an octree cell above this is split. 1024: octants part surfaces better than packing does, so `collide`
    takes 3 % less time than with 4096 where a voxel is 32 m and 16 % where it is 8 m, for 4 % more memory and 1 % more
    archive; with 256 it gains little more, for 16 % more memory (scripts/bench_engine --only cells).
    cells: "octree", or "balanced": cells are merged too, so that all trees have one height (balance.py).
    models: radius models stored, "mean" always and "local", "border" where asked: those need a byte a point. "mean"
    alone: `local` leaks 14 mm where it leaks 16, for a seventh more time, and makes narrow doors narrower, whose jambs
    are scanned thinly; `border` pays only on thin sheets (`solidcloud accuracy`; builder/DESIGN.md).
    radius: the figure that stands for `mean` [m]; None: half the mean closest-point distance.
    spacing: meshes are sampled about this far apart [m]; None: their vertices are taken.
    with_slab: cut each sphere by a slab; False is the paper's structure, for comparison, five times as slow.
    jobs: worker processes; 0: one a core.  memory_bytes: bound on what the passes hold.
    keep: extra columns, among "scan", "intensity" and "normal".  normal_reach: how near the points are that a normal
    is estimated of [m] (schemas/kernels/normals.py), where it is kept.  strict: a non-finite point fails the build.
    skip_bad: leave out scans that cannot be read and mark their region as unknown.
    overwrite: replace an archive of the same name, once the new one is whole.
    fresh: forget what a build of the same name that was interrupted has done.
    thin: keep one point a cell of this size [m]; None: all.
    outliers: leave out points with fewer than the second number of others within the first [m]; None: none.
    moving: leave out points that other scans saw through (builder/filter_rules.py): (distance [m], scans); None: none.
    scheduler: the address of a dask scheduler whose workers do the work; cluster: "local:N", one that is started for
    the build. Both None: processes of this one.
    """

    voxel: float = 8.0
    resolution: float | None = None
    degree: int = 8
    leaf: int = 32
    cell_points: int = 1024
    cells: str = "octree"
    spacing: float | None = None
    radius: float | None = None
    models: frozenset[str] = frozenset({"mean"})
    with_slab: bool = True
    jobs: int = 0
    memory_bytes: int = 2 << 30
    keep: frozenset[str] = field(default_factory=frozenset)
    normal_reach: float = NORMAL_REACH
    strict: bool = False
    skip_bad: bool = False
    overwrite: bool = False
    fresh: bool = False
    thin: float | None = None
    outliers: tuple[float, int] | None = None
    moving: tuple[float, int] | None = None
    scheduler: str | None = None
    cluster: str | None = None

    def __post_init__(self) -> None:
        """Refuse options outside what the format and the kernels hold."""
        checks = [
            (
                MIN_DEGREE <= self.degree <= MAX_DEGREE,
                f"--degree {self.degree}",
                f"{MIN_DEGREE} to {MAX_DEGREE}",
            ),
            (1 <= self.leaf <= MAX_LEAF, f"--leaf {self.leaf}", f"1 to {MAX_LEAF}"),
            (self.cell_points >= 1, f"cell_points {self.cell_points}", "at least 1"),
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
                "mean, and local or border where wanted",
            ),
            (self.jobs >= 0, f"--jobs {self.jobs}", "0 (all cores) or more"),
            (self.memory_bytes >= 64 << 20, f"--memory {self.memory_bytes} bytes", "at least 64MB"),
            (
                self.keep <= {"scan", "intensity", "normal"},
                f"--keep {','.join(sorted(self.keep))}",
                "scan, intensity, normal, by comma",
            ),
            (
                0 < self.normal_reach <= MAX_NORMAL_REACH,
                f"--normal-reach {self.normal_reach}",
                f"a length above 0, at most {MAX_NORMAL_REACH:g} m",
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
                "one of them: the workers of a scheduler that runs, or some that are started",
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

    def stored_models(self) -> tuple[str, ...]:
        """The radius models stored, in the order of STORED_MODELS."""
        return tuple(name for name in STORED_MODELS if name in self.models)

    def identity(self) -> dict[str, float | int | bool | str | None]:
        """The options that the archive's bytes depend on, for the index."""
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
            # Named only where it is not the default: archives without it stay what they were, byte for byte.
            **({} if self.cells == "octree" else {"cells": self.cells}),
            **({} if self.models == {"mean"} else {"models": ",".join(self.stored_models())}),
            **({"normal_reach": self.normal_reach} if "normal" in self.keep else {}),
            **({} if self.thin is None else {"thin": self.thin}),
            **({} if self.outliers is None else {"outliers": "{!r},{}".format(*self.outliers)}),
            **({} if self.moving is None else {"moving": "{!r},{}".format(*self.moving)}),
        }
