"""`solidcloud make`: test scans with known ground truth, avatars and walks."""

import os
from pathlib import Path
from typing import Annotated

import typer

from .....schemas.errors import BadRequestError
from ..command_options import interruptible, needs_extra

ScanOutput = Annotated[
    Path,
    typer.Option(
        "-o", "--output", help=".laz, .las or .e57 file, or a folder for one LAZ file per scanner station."
    ),
]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace an existing file.")]
Seed = Annotated[int, typer.Option(help="Random seed; the same seed gives the same points.")]


def make_facade(
    output: ScanOutput,
    points: Annotated[int, typer.Option(help="Exact number of points of the scan.")] = 587_923,
    seed: Seed = 2012,
    door: Annotated[float, typer.Option(help="Clear width of the main door [m].")] = 1.60,
    overwrite: Overwrite = False,
) -> None:
    """Make a scan of a Gothic façade.

    The scan is made by casting rays. Its ground truth is written beside the scan, as
    NAME.truth.json.
    """
    _check_new(output, overwrite)
    with needs_extra("made"):
        from .....builder.synthetic.scenes import make_facade as make_it
    from .....schemas.runtime.os_errors import naming_write_errors
    from ...output.progress_display import progress_listener

    with interruptible(), naming_write_errors(output), progress_listener() as bars:
        made = make_it(output, points=points, seed=seed, door=door, progress=bars.made)
    print(f"{made.points:,} points in {output}, ground truth in {made.truth}")


def make_town(
    output: ScanOutput,
    points: Annotated[
        int, typer.Option(help="Exact number of points of all scans; it determines the number of façades.")
    ],
    seed: Seed = 2012,
    overwrite: Overwrite = False,
) -> None:
    """Make scans of a town of façades.

    Each scan is as dense as that of make facade. The ground truth is written beside the scans, as
    NAME.truth.json.
    """
    _check_new(output, overwrite)
    with needs_extra("made"):
        from .....builder.synthetic.scenes import make_town as make_it
    from .....schemas.runtime.os_errors import naming_write_errors
    from ...output.progress_display import progress_listener

    with interruptible(), naming_write_errors(output), progress_listener() as bars:
        made = make_it(output, points=points, seed=seed, progress=bars.made)
    print(f"{made.points:,} points in {output}, ground truth in {made.truth}")


def make_office(
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help=".e57 file, or a folder for one LAZ file per scanner station."),
    ],
    seed: Seed = 2012,
    overwrite: Overwrite = False,
) -> None:
    """Make two scans of an office.

    They hold stray points: dust, and what one of the scans saw of a person in the door. The ground
    truth, which says which points they are, is written beside the scans, as NAME.truth.json.
    """
    _check_new(output, overwrite)
    with needs_extra("made"):
        from .....builder.synthetic.office import make_office as make_it
    from .....schemas.runtime.os_errors import naming_write_errors
    from ...output.progress_display import progress_listener

    with interruptible(), naming_write_errors(output), progress_listener() as bars:
        made = make_it(output, seed=seed, progress=bars.made)
    print(f"{made.points:,} points in {output}, ground truth in {made.truth}")


def make_figure(
    output: Annotated[Path, typer.Option("-o", "--output", help=".obj or .ply file to write.")],
    points: Annotated[int, typer.Option(help="Exact number of points of the figure.")] = 3617,
    seed: Seed = 2012,
    height: Annotated[float, typer.Option(help="Height of the figure [m].")] = 1.75,
    overwrite: Overwrite = False,
) -> None:
    """Make an avatar: a human figure in mid-stride."""
    _check_new(output, overwrite)
    from .....builder.synthetic.figure import figure_points, write_figure
    from .....schemas.runtime.os_errors import naming_write_errors

    with interruptible(), naming_write_errors(output):
        write_figure(output, figure_points(points, seed, height))
    print(f"{points:,} points in {output}")


def make_walk(
    truth: Annotated[Path, typer.Argument(help="NAME.truth.json, as make facade writes it.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV file of poses to write.")],
    frames: Annotated[int, typer.Option(min=2, help="Number of poses, 30 per second.")] = 1200,
    overwrite: Overwrite = False,
) -> None:
    """Write the poses of a walk through a façade.

    The façade must be one of make facade. The columns are t,x,y,z,qw,qx,qy,qz, as solidcloud query
    reads them.
    """
    _check_new(output, overwrite)
    from .....builder.synthetic.truth import read_truth
    from .....builder.synthetic.walk import walk_poses
    from .....schemas.runtime.os_errors import naming_write_errors
    from ...input.pose_file import write_poses

    with interruptible(), naming_write_errors(output):
        write_poses(output, *walk_poses(read_truth(truth).facades[0], frames))
    print(f"{frames} poses in {output}")


def _check_new(output: Path, overwrite: bool) -> None:
    """Raise BadRequestError if a file exists that may not be replaced."""
    if not overwrite and os.path.lexists(output) and not output.is_dir():
        raise BadRequestError(f"{output}: exists, expected no such file: give another -o, or --overwrite")
