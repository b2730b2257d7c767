"""`solidcloud build`: build an archive from scans."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .....builder.sources.format_table import FORMATS
from .....schemas.runtime.own_command import own_command
from ..command_options import AsJson, among, interruptible, parse_bytes, print_json, print_warning

if TYPE_CHECKING:
    from .....builder.config import BuildConfig
    from .....builder.pipeline import BuildSummary

Scans = Annotated[
    list[Path],
    typer.Argument(
        help="Scans, folders of scans, or a scans.toml. Formats: "
        f"{' '.join(row.name for row in FORMATS if row.in_folders)}."
    ),
]


def build(
    scans: Scans,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the archive to write.")],
    voxel: Annotated[float, typer.Option(help="Edge of a voxel [m].")] = 8.0,
    resolution: Annotated[
        float | None,
        typer.Option(
            help="Lattice step [m]; default: that of all scans, else 0.0001 or a tenth of their spacing."
        ),
    ] = None,
    degree: Annotated[int, typer.Option(help="Maximum number of children of a node.")] = 8,
    leaf: Annotated[int, typer.Option(help="Maximum number of points of a leaf node.")] = 32,
    cells: Annotated[
        str,
        typer.Option(
            help="octree, or balanced: also merge octree cells, so that all trees have one height.",
            autocompletion=among("octree", "balanced"),
        ),
    ] = "octree",
    cell_points: Annotated[
        int | None,
        typer.Option(min=1, max=1 << 20, help="Maximum number of points of a leaf cell; default: 1024."),
    ] = None,
    leaf_cells: Annotated[
        int | None,
        typer.Option(help="Choose --cell-points so that the archive has about this many leaf cells."),
    ] = None,
    jobs: Annotated[int, typer.Option(help="Worker processes; 0: one per core.")] = 0,
    memory: Annotated[str, typer.Option(help="Memory bound of the build, all processes together.")] = "2GB",
    spacing: Annotated[
        float | None,
        typer.Option(help="Sample meshes at this spacing [m]; default: take their vertices."),
    ] = None,
    keep: Annotated[
        str,
        typer.Option(help="Columns to keep, separated by commas: scan, intensity, rgb, classification."),
    ] = "",
    radius: Annotated[
        str,
        typer.Option(
            help="Radius models to store, separated by commas: mean, local, border; fixed:METRES, or a number, "
            "replaces mean."
        ),
    ] = "mean",
    thin: Annotated[float | None, typer.Option(help="Keep one point per cube of this size [m].")] = None,
    outliers: Annotated[
        str | None,
        typer.Option(help="METRES,COUNT: leave out points with fewer than COUNT other points within METRES."),
    ] = None,
    moving: Annotated[
        str | None,
        typer.Option(
            help="METRES,SCANS: leave out moving objects: points with fewer than SCANS other scans within METRES, "
            "where at least SCANS other scans cover the place (have points within 8 times METRES)."
        ),
    ] = None,
    drop_classes: Annotated[
        str,
        typer.Option(
            help="Classes of points to leave out, separated by commas: numbers, and synthetic for points with that "
            "flag in LAS. 7 and 18 are noise in LAS. Withheld points are always left out."
        ),
    ] = "",
    scheduler: Annotated[
        str | None,
        typer.Option(help="Address of a dask scheduler whose workers run the build: tcp://HOST:PORT."),
    ] = None,
    cluster: Annotated[
        str | None, typer.Option(help="local:N: start a dask cluster of N workers for this build.")
    ] = None,
    no_level: Annotated[
        bool,
        typer.Option(
            "--no-level", help="Write no level of detail, from which servers answer before they load."
        ),
    ] = False,
    strict: Annotated[bool, typer.Option("--strict", help="Fail on a point that is not finite.")] = False,
    skip_bad: Annotated[
        bool,
        typer.Option("--skip-bad", help="Leave out broken scans; queries answer unknown in their region."),
    ] = False,
    overwrite: Annotated[
        bool,
        typer.Option("--overwrite", help="Replace an existing archive, once the new one is complete."),
    ] = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Start over instead of resuming an interrupted build.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Estimate time, disk space and memory; build nothing.")
    ] = False,
    log_json: Annotated[
        bool,
        typer.Option("--log-json", help="Report progress on standard error as one JSON object per line."),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Build one archive from scans. The same command resumes an interrupted build."""
    from .....builder.resume.lock import check_free

    if not dry_run:
        check_free(output)  # before loading numba, which takes a second
    from .....builder.config import DEFAULT_CELL_POINTS, BuildConfig, parse_radius, parse_rule
    from .....builder.sources.common.colours import parse_classes
    from .....schemas.errors import BadRequestError

    if cell_points is not None and leaf_cells is not None:
        raise BadRequestError(
            f"--cell-points {cell_points} and --leaf-cells {leaf_cells}: expected only one of them: the number of "
            "cells follows from their size"
        )
    fixed, models = parse_radius(radius)
    config = BuildConfig(
        voxel=voxel,
        resolution=resolution,
        degree=degree,
        leaf=leaf,
        cells=cells,
        cell_points=DEFAULT_CELL_POINTS if cell_points is None else cell_points,
        leaf_cells=leaf_cells,
        jobs=jobs,
        memory_bytes=parse_bytes(memory, "--memory"),
        spacing=spacing,
        keep=frozenset(filter(None, keep.split(","))),
        level=not no_level,
        radius=fixed,
        models=models,
        strict=strict,
        skip_bad=skip_bad,
        overwrite=overwrite,
        fresh=fresh,
        thin=thin,
        outliers=parse_rule(outliers, "--outliers"),
        moving=parse_rule(moving, "--moving"),
        drop_classes=parse_classes(drop_classes),
        scheduler=scheduler,
        cluster=cluster,
    )
    if dry_run:
        _estimate(scans, output, config, as_json)
    else:
        _build(scans, output, config, log_json, as_json)


def _build(scans: list[Path], output: Path, config: "BuildConfig", log_json: bool, as_json: bool) -> None:
    """Build the archive and print its summary."""
    from .....builder.passes.archive_summary import summarize_archive
    from .....builder.pipeline import build_archive
    from .....schemas.archive.archive import Archive
    from .....schemas.runtime.os_errors import naming_write_errors
    from ...output.archive_facts import print_summary
    from ...output.console import print_build
    from ...output.progress_display import progress_listener

    built: list[BuildSummary] = []
    said: set[str] = set()

    def warn(text: str) -> None:
        """Print a warning at once: the build may take hours."""
        said.add(text)
        print_warning(text)

    whole = f"{output} is complete: the build had finished"
    with (
        interruptible(lambda: whole if built else _kept_work(output)),
        naming_write_errors(output),
        progress_listener(log_json) as listener,
    ):
        built.append(build_archive(scans, output, config, listener, None if log_json else warn))
    summary = built[0]
    with Archive(output) as archive:
        short = summarize_archive(archive)
    if as_json:
        plain = {
            "archive": str(summary.archive),
            "columns": dict(summary.columns),
            "summary": short.as_json(),
        }
        print_json({**summary._asdict(), **plain})
    else:
        print_build(summary)
        print_summary(short)
    if summary.already:
        print(
            f"{output}: already complete, with these scans and these options: nothing was built. Only its index was "
            f"checked; `{own_command()} validate` reads its records, --overwrite builds it again",
            file=sys.stderr,
        )
    for warning in summary.warnings:
        if warning not in said:
            print_warning(warning)
    for fault in summary.faults:
        print(f"left out: {fault}", file=sys.stderr)


def _kept_work(output: Path) -> str:
    """Return a sentence about the files that an interrupted build leaves."""
    from .....builder.resume.kept_work import building_folder

    folder = building_folder(output)
    if folder.exists():
        return f"completed work is kept in {folder}: the same command resumes the build, --fresh starts over"
    return "nothing was written"


def _estimate(scans: Sequence[Path], output: Path, config: "BuildConfig", as_json: bool) -> None:
    """Print the estimated cost of a build."""
    from .....builder.plan.build_plan import estimate
    from .....builder.plan.rates import load_rates
    from .....builder.plan.scan_sample import sample_scene
    from .....builder.sources.scan_files import open_input_files
    from .plan_command import print_plan

    with interruptible():
        inputs = open_input_files(scans, config.spacing, drop_classes=config.drop_classes)
        found = estimate(sample_scene(inputs, config), config, load_rates(), output)
    print_plan(found, as_json)
