"""`solidcloud build`: scans to an archive."""

import sys
from pathlib import Path
from typing import Annotated

import typer

from .options import AsJson, parse_bytes, print_json

Scans = Annotated[
    list[Path], typer.Argument(help="Scans or folders of scans: LAS LAZ E57 PLY XYZ PTS OBJ STL.")
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
    memory: Annotated[str, typer.Option(help="What the build may hold in memory.")] = "2GB",
    spacing: Annotated[
        float | None, typer.Option(help="Sample meshes this far apart [m] instead of at vertices.")
    ] = None,
    keep: Annotated[str, typer.Option(help="Columns to keep: scan, intensity or both, by comma.")] = "",
    radius: Annotated[
        str,
        typer.Option(
            help="Radius models to store, by comma: mean, local, border; fixed:METRES, or a number, in place of mean."
        ),
    ] = "mean",
    strict: Annotated[bool, typer.Option("--strict", help="Fail on a point that is not finite.")] = False,
    skip_bad: Annotated[
        bool, typer.Option("--skip-bad", help="Leave out broken scans; their region is unknown.")
    ] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the archive once the new one is whole.")
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Build one archive from scans."""
    from ...builder.config import BuildConfig, parse_radius
    from ...builder.pipeline import build_archive
    from ..console import Bars, print_build

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
        radius=fixed,
        models=models,
        strict=strict,
        skip_bad=skip_bad,
        overwrite=overwrite,
    )
    with Bars() as bars:
        summary = build_archive(scans, output, config, bars)
    if as_json:
        print_json({**summary._asdict(), "archive": str(summary.archive)})
    else:
        print_build(summary)
    for fault in summary.faults:
        print(f"left out: {fault}", file=sys.stderr)
