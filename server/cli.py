"""The command `solidcloud`: what each verb takes, what it prints, and the code it exits with.

Every verb imports what it needs inside itself: `--help` is to be answered before numpy could be loaded.
Exit codes: 0; 1 failed; 2 a request that cannot be understood; 3 bad data; 130 interrupted.
"""

import json
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer

from ..schemas.errors import BadRequestError, SolidcloudError

# Without rich's markup: importing it doubles the time --help takes, to over the 0.3 s it may.
app = typer.Typer(
    help="Makes scanned point clouds solid: build an archive, serve it, ask what touches it.",
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)
make = typer.Typer(
    help="Make scenes with known truth, and what walks through them.",
    rich_markup_mode=None,
)
app.add_typer(make, name="make")

Scans = Annotated[
    list[Path], typer.Argument(help="Scans or folders of scans: LAS LAZ E57 PLY XYZ PTS OBJ STL.")
]
ArchivePath = Annotated[Path, typer.Argument(help="Folder of an archive.")]
Output = Annotated[Path, typer.Option("-o", "--output", help="File to write.")]
ScanOutput = Annotated[
    Path,
    typer.Option("-o", "--output", help=".laz, .las or .e57 file, or a folder for a LAZ file a station."),
]
Seed = Annotated[int, typer.Option(help="The same seed gives the same points.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]


def main() -> None:
    """Run the command and exit."""
    sys.exit(run(sys.argv[1:]))


def run(arguments: Sequence[str]) -> int:
    """Run the command with these arguments and return its exit code; an error is one line, not a traceback."""
    try:
        command, name, rest = _find_verb(arguments or ["--help"])
        code = command.main(args=rest, prog_name=name, standalone_mode=False)
        return code if isinstance(code, int) else 0
    except SolidcloudError as error:
        return _complain(str(error), error.exit_code)
    except typer.TyperException as error:
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "solidcloud"
        return _complain(
            f"{error.format_message().rstrip('.')}: see {command} --help", BadRequestError.exit_code
        )
    except (KeyboardInterrupt, typer.Abort):
        return _complain("interrupted", 130)
    except BrokenPipeError:
        # Whoever read the output has had enough. Python would complain again when it flushes at exit.
        sys.stdout = None
        return 1
    except (OSError, MemoryError) as error:
        return _complain(str(error) or type(error).__name__, 1)


def _find_verb(arguments: Sequence[str]) -> tuple[Any, str, list[str]]:
    """The command that the first arguments name, its full name, and the arguments left for it.

    Left to itself, typer would look at the options of `solidcloud` first, of which there are none, and load
    pydantic for it: half of the time that `solidcloud build --help` takes.
    """
    command: Any = typer.main.get_command(app)
    name, rest = "solidcloud", list(arguments)
    while rest and rest[0] in getattr(command, "commands", ()):
        command = command.commands[rest[0]]
        name += f" {rest.pop(0)}"
    return command, name, rest


@make.command("facade")
def make_facade(
    output: ScanOutput,
    points: Annotated[int, typer.Option(help="Points of the scan, exactly.")] = 587_923,
    seed: Seed = 2012,
    door: Annotated[float, typer.Option(help="Clear width of the main door [m].")] = 1.60,
) -> None:
    """Make a Gothic façade, scanned by casting rays.

    Its truth is written beside the scan, as NAME.truth.json.
    """
    with _extra("made"):
        from ..builder.made.scenes import make_facade as make_it
    from .console import Bars

    with Bars() as bars:
        made = make_it(output, points=points, seed=seed, door=door, progress=bars.made)
    print(f"{made.points:,} points in {output}, the truth in {made.truth}")


@make.command("town")
def make_town(
    output: ScanOutput,
    points: Annotated[int, typer.Option(help="Points of all scans, exactly; as many façades as that takes.")],
    seed: Seed = 2012,
) -> None:
    """Make a town of façades, each as dense as one.

    Its truth is written beside the scan, as NAME.truth.json.
    """
    with _extra("made"):
        from ..builder.made.scenes import make_town as make_it
    from .console import Bars

    with Bars() as bars:
        made = make_it(output, points=points, seed=seed, progress=bars.made)
    print(f"{made.points:,} points in {output}, the truth in {made.truth}")


@make.command("figure")
def make_figure(
    output: Annotated[Path, typer.Option("-o", "--output", help=".obj or .ply file to write.")],
    points: Annotated[int, typer.Option(help="Points of the figure, exactly.")] = 3617,
    seed: Seed = 2012,
    height: Annotated[float, typer.Option(help="Height of the figure [m].")] = 1.75,
) -> None:
    """Make a human figure in mid-walk: an avatar."""
    from ..builder.made.figure import figure_points, write_figure

    write_figure(output, figure_points(points, seed, height))
    print(f"{points:,} points in {output}")


@make.command("walk")
def make_walk(
    truth: Annotated[Path, typer.Argument(help="The NAME.truth.json of a made façade.")],
    output: Annotated[Path, typer.Option("-o", "--output", help="CSV file of poses to write.")],
    frames: Annotated[int, typer.Option(min=2, help="Poses, 30 a second.")] = 1200,
) -> None:
    """Write the walk through a made façade as poses.

    Columns t,x,y,z,qw,qx,qy,qz, as query takes them.
    """
    from ..builder.made.truth import read_truth
    from ..builder.made.walk import walk_poses
    from .pose_file import write_poses

    write_poses(output, *walk_poses(read_truth(truth).facades[0], frames))
    print(f"{frames} poses in {output}")


@app.command()
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
    from ..builder.config import BuildConfig, parse_radius
    from ..builder.pipeline import build_archive
    from .console import Bars, print_build

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
        _print_json({**summary._asdict(), "archive": str(summary.archive)})
    else:
        print_build(summary)
    for fault in summary.faults:
        print(f"left out: {fault}", file=sys.stderr)


@app.command()
def info(archive: ArchivePath, as_json: AsJson = False) -> None:
    """Say what an archive holds."""
    import msgspec

    from ..schemas.index import radius_distribution
    from .console import print_info
    from .scene import describe
    from .store import Store

    store = Store(archive)
    found = describe(store, archive.resolve().name)
    classes = radius_distribution(store.archive.header)
    store.close()
    if as_json:
        _print_json({**msgspec.to_builtins(found), "radius_classes": msgspec.to_builtins(classes)})
    else:
        print_info(found, classes)


@app.command()
def validate(
    archive: ArchivePath,
    deep: Annotated[bool, typer.Option("--deep", help="Also measure every bound again.")] = False,
    exact: Annotated[bool, typer.Option("--exact", help="Also prove bounds in Python's integers.")] = False,
    sample: Annotated[
        int | None, typer.Option(help="With --exact: only so many bounds, of all over it.")
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Check every record; exit code 3 if one is broken."""
    from ..builder.verify import verify_archive
    from .console import Bars

    with Bars() as bars:
        report = verify_archive(archive, deep=deep, exact=exact, sample=sample, progress=bars)
    if as_json:
        _print_json(report._asdict())
    else:
        proved = f", {report.exact_nodes:,} of {report.nodes:,} bounds proved" if exact else ""
        counted = f"{report.voxels:,} voxels, {report.points:,} points{proved}"
        print(f"{archive}: {counted}, {len(report.faults)} faults")
    for fault in report.faults:
        _complain(fault, 3)
    raise typer.Exit(3 if report.faults else 0)


@app.command()
def serve(
    archive: ArchivePath,
    name: Annotated[str | None, typer.Option(help="Scene name for clients; left out: the folder's.")] = None,
    listen: Annotated[str, typer.Option(help="zenoh endpoint.")] = "tcp/127.0.0.1:7447",
    cache: Annotated[str, typer.Option(help="Decoded voxels kept in memory, at most.")] = "512MB",
    insecure: Annotated[
        bool, typer.Option("--insecure", help="Allow an endpoint that other hosts reach.")
    ] = False,
) -> None:
    """Serve an archive over zenoh until told to stop."""
    import logging

    from .app import serve as serve_scenes
    from .config import ServerConfig
    from .scene import Scene

    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(levelname)s %(message)s")
    config = ServerConfig(listen=listen, insecure=insecure)
    with Scene.open(archive, name, budget_bytes=parse_bytes(cache, "--cache")) as scene:
        serve_scenes([scene], config)


@app.command()
def accuracy(
    archive: Annotated[
        Path | None, typer.Argument(help="Folder of an archive; left out: a façade is made.")
    ] = None,
    avatar: Annotated[
        Path | None, typer.Option(help="Points of the avatar; left out: a made figure.")
    ] = None,
    output: Annotated[Path, typer.Option("-o", "--output", help="Folder to write.")] = Path("report"),
    full: Annotated[bool, typer.Option("--full", help="More settings, poses and repetitions.")] = False,
) -> None:
    """Measure what accuracy costs.

    Each knob is turned by itself. Writes a table, a page and charts.
    """
    import tempfile

    with _extra("made"):
        from .report.accuracy import run as measure
    from .console import Bars
    from .report.accuracy_plan import BRIEF, FULL
    from .report.accuracy_words import findings

    with tempfile.TemporaryDirectory(prefix="solidcloud-accuracy-") as scratch, Bars() as bars:
        report = measure(output, Path(scratch), FULL if full else BRIEF, bars, archive, avatar)
    for line in (
        *report.facts["warnings"],
        *findings(report.rows, report.facts["poses_judged_by_every_pair"]),
    ):
        print(line)
    print(f"{output / 'accuracy.html'}, beside it accuracy.csv, accuracy.json and the charts")


@app.command()
def query(
    scene: Annotated[str, typer.Option(help="Name of the scene.")],
    op: Annotated[
        str,
        typer.Option(help="collide, distance, contacts, sweep, raycast, within, objects, or path in parts."),
    ] = "collide",
    avatar: Annotated[
        Path | None, typer.Option(help="Points of the avatar: OBJ PLY XYZ and what build reads.")
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(help="CSV file of poses: t,x,y,z,qw,qx,qy,qz; a sweep moves from each to the next."),
    ] = None,
    rays: Annotated[Path | None, typer.Option(help="CSV file of rays: x,y,z,dx,dy,dz.")] = None,
    points: Annotated[Path | None, typer.Option(help="Loose points: PLY XYZ and what build reads.")] = None,
    objects: Annotated[
        Path | None, typer.Option(help="CSV file of objects: avatar,x,y,z,qw,qx,qy,qz,group,mask.")
    ] = None,
    along: Annotated[
        str | None, typer.Option(help="What path asks: collide (default), distance, contacts or sweep.")
    ] = None,
    connect: Annotated[str, typer.Option(help="zenoh endpoint of the server.")] = "tcp/127.0.0.1:7447",
    margin: Annotated[
        float | None, typer.Option(help="Distance below which it is contact [m]; default 0.")
    ] = None,
    reach: Annotated[float | None, typer.Option(help="Farthest distance worth reporting [m].")] = None,
    limit: Annotated[
        int | None, typer.Option(help="Contacts listed for a pose, the deepest; default 100.")
    ] = None,
    cluster_distance: Annotated[
        float | None, typer.Option(help="How far apart points of one cluster may lie [m].")
    ] = None,
    radius: Annotated[
        float | None,
        typer.Option(help="Radius of an avatar point [m]; left out: half the mean closest-point distance."),
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(help="How early contact may be called [m]; default 0, of a sweep 1e-6.")
    ] = None,
    budget_ms: Annotated[float | None, typer.Option(help="Time for it all [ms]; default none.")] = None,
    budget_visits: Annotated[int | None, typer.Option(help="Node visits a pose; default none.")] = None,
    radius_model: Annotated[
        str | None,
        typer.Option(
            help="Radii of the scan's points: mean, local, border, local+border, each with a factor as in "
            "local:0.8 if wanted, or fixed:METRES; default: the scene's one figure."
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Ask a server what poses of an avatar, rays, points or objects touch."""
    options = {name: value for name, value in locals().items() if name not in _NOT_OF_THE_QUESTION}
    from .answer_text import answer_lines, answers_json, summary_line
    from .client import Client
    from .query import ask, check_query, joined
    from .report.points import read_avatar

    question = check_query(op, options)
    found = []
    with Client(connect, scene=scene) as client:
        for part in ask(client, question, read_avatar):
            found.append(part)
            if not as_json:
                for line in answer_lines(*part):
                    print(line, flush=op == "path")
    whole = joined(found)
    if whole.labels and whole.answers.engine_seconds == 0.0:
        print(f"no server of scene {scene!r} answered at {connect}", file=sys.stderr)
    if as_json:
        _print_json(answers_json(whole.times, whole.answers))
    else:
        print(summary_line(whole.answers))


# Options of `query` that are not parameters of what is asked.
_NOT_OF_THE_QUESTION = ("scene", "op", "connect", "as_json")


def parse_bytes(text: str, option: str) -> int:
    """A size such as 512MB or 2GB in bytes, in steps of 1024; BadRequestError names the option."""
    match = re.fullmatch(r"(\d+(?:\.\d+)?)\s*([KMGT]?)i?B?", text.strip(), re.IGNORECASE)
    if not match:
        raise BadRequestError(f"{option} {text!r}: expected a size such as 512MB or 2GB")
    return int(float(match[1]) * 1024 ** " KMGT".index(match[2].upper() or " "))


@contextmanager
def _extra(name: str) -> Iterator[None]:
    """Say which extra to install where a library of it is missing."""
    try:
        yield
    except ModuleNotFoundError as error:
        if (error.name or "").startswith("solidcloud"):
            raise
        raise SolidcloudError(
            f"the library {error.name!r} is not installed: pip install 'solidcloud[{name}]'"
        ) from None


def _complain(message: str, code: int) -> int:
    """Print one line on standard error; returns the exit code."""
    print(f"error: {' '.join(message.splitlines())}", file=sys.stderr)
    return code


def _print_json(value: Any) -> None:
    print(json.dumps(value, indent=1, allow_nan=False))


if __name__ == "__main__":
    main()
