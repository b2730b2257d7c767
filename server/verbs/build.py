"""`solidcloud build`: scans to an archive."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .interrupt import interruptible
from .options import AsJson, parse_bytes, print_json

if TYPE_CHECKING:
    from ...builder.config import BuildConfig
    from ...builder.pipeline import BuildSummary

Scans = Annotated[
    list[Path],
    typer.Argument(
        help="Scans, folders of scans, or a scans.toml: LAS LAZ E57 PLY PTX PTS XYZ PCD OBJ STL GLB."
    ),
]


def build(
    scans: Scans,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder of the archive to write.")],
    voxel: Annotated[float, typer.Option(help="Edge of a voxel [m].")] = 8.0,
    resolution: Annotated[
        float | None,
        typer.Option(help="Lattice step [m]; left out: the scans' own where they share one, else 0.0001."),
    ] = None,
    degree: Annotated[int, typer.Option(help="Children of a node.")] = 8,
    leaf: Annotated[int, typer.Option(help="Points of a leaf node, at most.")] = 32,
    cells: Annotated[
        str, typer.Option(help="octree, or balanced: cells merged too, so that all trees have one height.")
    ] = "octree",
    jobs: Annotated[int, typer.Option(help="Worker processes; 0: one a core.")] = 0,
    memory: Annotated[
        str, typer.Option(help="What the build may hold in memory, all processes together.")
    ] = "2GB",
    spacing: Annotated[
        float | None, typer.Option(help="Sample meshes this far apart [m] instead of at vertices.")
    ] = None,
    keep: Annotated[str, typer.Option(help="Columns to keep: scan, intensity, normal, by comma.")] = "",
    normal_reach: Annotated[
        float, typer.Option(help="A normal is estimated of the points so near [m], where normals are kept.")
    ] = 0.08,
    radius: Annotated[
        str,
        typer.Option(
            help="Radius models to store, by comma: mean, local, border; fixed:METRES, or a number, in place of mean."
        ),
    ] = "mean",
    thin: Annotated[float | None, typer.Option(help="Keep one point a cell of this size [m].")] = None,
    outliers: Annotated[
        str | None, typer.Option(help="METRES,COUNT: leave out points with fewer others than that so near.")
    ] = None,
    moving: Annotated[
        str | None,
        typer.Option(help="METRES,SCANS: leave out what fewer other scans saw so near than saw the place."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(help="Address of a dask scheduler whose workers do the work: tcp://HOST:PORT."),
    ] = None,
    cluster: Annotated[
        str | None, typer.Option(help="local:N: a dask cluster of N workers, started for this build.")
    ] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Fail on a point that is not finite.")] = False,
    skip_bad: Annotated[
        bool, typer.Option("--skip-bad", help="Leave out broken scans; their region is unknown.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the archive once the new one is whole.")
    ] = False,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Start over, where a build that was interrupted could go on.")
    ] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what it would take: time, disk, memory; build nothing.")
    ] = False,
    log_json: Annotated[
        bool, typer.Option("--log-json", help="Say how it goes as one JSON object a line, on standard error.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Build one archive from scans; the same command again goes on where it was interrupted."""
    from ...builder.lock import check_free

    if not dry_run:
        check_free(output)  # before a second is spent on loading numba
    from ...builder.config import BuildConfig, parse_radius, parse_rule

    fixed, models = parse_radius(radius)
    config = BuildConfig(
        voxel=voxel,
        resolution=resolution,
        degree=degree,
        leaf=leaf,
        cells=cells,
        jobs=jobs,
        memory_bytes=parse_bytes(memory, "--memory"),
        spacing=spacing,
        keep=frozenset(filter(None, keep.split(","))),
        normal_reach=normal_reach,
        radius=fixed,
        models=models,
        strict=strict,
        skip_bad=skip_bad,
        overwrite=overwrite,
        fresh=fresh,
        thin=thin,
        outliers=parse_rule(outliers, "--outliers"),
        moving=parse_rule(moving, "--moving"),
        scheduler=scheduler,
        cluster=cluster,
    )
    if dry_run:
        _estimate(scans, output, config, as_json)
    else:
        _build(scans, output, config, log_json, as_json)


def _build(scans: list[Path], output: Path, config: "BuildConfig", log_json: bool, as_json: bool) -> None:
    """Build, and say what was built."""
    from ...builder.pipeline import build_archive
    from ...schemas.os_errors import writing
    from ..console import print_build
    from ..progress import progress_listener

    built: list[BuildSummary] = []
    whole = f"{output} is whole: all was done"
    with (
        interruptible(lambda: whole if built else _kept(output)),
        writing(output),
        progress_listener(log_json) as listener,
    ):
        built.append(build_archive(scans, output, config, listener))
    summary = built[0]
    if as_json:
        print_json({**summary._asdict(), "archive": str(summary.archive)})
    else:
        print_build(summary)
    if summary.already:
        print(
            f"{output}: whole already, of these scans with these options: nothing was built. Its index says so: its "
            "records were not read, which `solidcloud validate` does; --overwrite builds it anew",
            file=sys.stderr,
        )
    for warning in summary.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    for fault in summary.faults:
        print(f"left out: {fault}", file=sys.stderr)


def _kept(output: Path) -> str:
    """Say what is left of a build that was interrupted."""
    from ...builder.workplace import building_folder

    folder = building_folder(output)
    if folder.exists():
        return f"what is done is kept in {folder}: the same command goes on where it was, --fresh starts over"
    return "nothing was done"


def _estimate(scans: Sequence[Path], output: Path, config: "BuildConfig", as_json: bool) -> None:
    """Say what a build would take."""
    from ...builder.plan import estimate, load_rates
    from ...builder.sample import seen_scene
    from ...builder.scan_list import inputs
    from ..console import print_facts
    from .plan import plan_facts

    with interruptible():
        found = estimate(seen_scene(inputs(scans, config.spacing), config), config, load_rates(), output)
    if as_json:
        print_json(found.as_json())
    else:
        print_facts(plan_facts(found))
