"""`solidcloud loadtest`: a server of an archive under the load of simulated users."""

import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from .command_options import ArchivePath, AvatarUnits, AvatarUp, needs_extra, read_avatar_points


def loadtest(
    archive: ArchivePath,
    walks: Annotated[
        list[Path] | None,
        typer.Option(
            "--walk",
            help="Poses of a user (CSV t,x,y,z,qw,qx,qy,qz, or TUM: .tum, .txt); repeat it for several walks. "
            "Default: walks made on the archive's floor.",
        ),
    ] = None,
    truth: Annotated[
        Path | None,
        typer.Option(
            help="Ground truth of a generated town, whose users go through its doors; "
            "default: ARCHIVE.truth.json, if it exists."
        ),
    ] = None,
    avatar: Annotated[
        Path | None, typer.Option(help="Points of the avatar; default: a generated human figure.")
    ] = None,
    avatar_up: AvatarUp = None,
    avatar_units: AvatarUnits = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder of load.html, load.json and load.csv.")
    ] = Path("load"),
    only: Annotated[
        str, typer.Option(help="Sections to run, separated by commas.")
    ] = "start,kinds,budgets,speeds,users",
    kinds: Annotated[
        str, typer.Option(help="Kinds of made users, separated by commas.")
    ] = "stroll,run,turn,tour,crowd,teleport,adversary",
    users: Annotated[int, typer.Option(min=1, help="Users in all sections but users.")] = 8,
    seconds: Annotated[float, typer.Option(min=2.0, help="Duration of each run [s].")] = 30.0,
    budget: Annotated[
        float | None,
        typer.Option(
            help="Cache as a share of the decoded archive; default: 0.1, or what the archive needs."
        ),
    ] = None,
    budgets: Annotated[
        str | None,
        typer.Option(help="Shares of section budgets; default: 0.03,0.05,0.1,0.2,0.4, as far as possible."),
    ] = None,
    speeds: Annotated[str, typer.Option(help="Speeds of section speeds [m/s].")] = "0.75,1.5,3,5,8",
    crowds: Annotated[str, typer.Option(help="Numbers of users of section users.")] = "8,16,32,64,128",
    policies: Annotated[str, typer.Option(help="Eviction policies to compare.")] = "lru+prefetch,lru",
    budget_ms: Annotated[
        float | None,
        typer.Option(help="Time budget of each request: unknown instead of a longer wait for voxels."),
    ] = None,
    processes: Annotated[int, typer.Option(min=0, help="Processes of users; 0: one per core.")] = 0,
    seed: Annotated[int, typer.Option(help="Seed of made walks.")] = 2012,
    record: Annotated[
        Path | None, typer.Option(help="Keep the traces of section kinds as FOLDER/KIND.npz.")
    ] = None,
    replay: Annotated[
        Path | None, typer.Option(help="Section kinds replays FOLDER/KIND.npz, with its users.")
    ] = None,
) -> None:
    """Load a server with simulated users.

    Starts servers of its own. Sections: start (time to the first right answer), kinds (of users),
    budgets (hit rate over the cache's size), speeds (stalls over the users' speed), users (round
    trips beside a bare zenoh echo). Every verdict is compared with a scene that is in memory as a
    whole. The page load.html is up to date while the test runs. Exit code 1: an answer was wrong,
    or a section ended early; missed targets do not matter.
    """
    from ....schemas.errors import BadRequestError
    from ....schemas.runtime.os_errors import naming_write_errors

    with needs_extra("report"):
        from ...report.common.sphere_pictures import load_pyplot

        load_pyplot()  # fails now if matplotlib is missing, not after minutes of measuring
        from ...report.load.load_test import ALL_KINDS, SECTIONS, LoadOptions, run_load_test
    from ...report.common.bench_results import show
    from ...report.load.runs.load_cases import NOTES
    from ...report.load.runs.load_run import cores
    from ..output.progress_display import progress_listener

    beside = archive.with_name(f"{archive.name}.truth.json")
    if truth is None and not walks and beside.exists():
        truth = beside
    options = LoadOptions(
        sections=_names(only, "--only", SECTIONS),
        kinds=_names(kinds, "--kinds", ALL_KINDS),
        walks=tuple(walks or ()),
        truth=truth,
        avatar=None if avatar is None else read_avatar_points(avatar, avatar_up, avatar_units),
        users=users,
        seconds=seconds,
        budget=budget,
        budgets=None if budgets is None else _numbers(budgets, "--budgets"),
        speeds=_numbers(speeds, "--speeds"),
        crowds=tuple(int(count) for count in _numbers(crowds, "--crowds")),
        policies=tuple(filter(None, policies.split(","))),
        budget_ms=budget_ms,
        processes=processes or cores(),
        seed=seed,
        record=record,
        replay=replay,
    )
    if min(options.crowds) < 1:
        raise BadRequestError(f"--crowds {crowds}: expected numbers of users, at least 1")
    print(f"results: {output / 'load.html'}, up to date after every run", file=sys.stderr)
    # Like Ctrl-C, SIGTERM must end the processes of the server and of the users, too.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    try:
        with naming_write_errors(output), progress_listener() as bars:
            report = run_load_test(archive, options, output, bars)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"results so far: {output / 'load.html'}") from None
    show(report.parts, NOTES, "Residency")
    print(f"wrote {output / 'load.html'}, load.json and load.csv")
    raise typer.Exit(int(report.failed))


def _names(text: str, option: str, known: tuple[str, ...]) -> tuple[str, ...]:
    """Parse names separated by commas. Raises BadRequestError for an unknown one, or none."""
    from ....schemas.errors import BadRequestError

    names = tuple(part.strip() for part in text.split(",") if part.strip())
    if unknown := [name for name in names if name not in known]:
        raise BadRequestError(f"{option}: {', '.join(unknown)}: expected some of {', '.join(known)}")
    if not names:
        raise BadRequestError(f"{option}: none given: expected some of {', '.join(known)}")
    return names


def _numbers(text: str, option: str) -> tuple[float, ...]:
    """Parse positive numbers separated by commas. Raises BadRequestError."""
    from ....schemas.errors import BadRequestError

    try:
        numbers = tuple(float(part) for part in text.split(",") if part.strip())
    except ValueError:
        numbers = ()
    if not numbers or not all(0 < number < float("inf") for number in numbers):
        raise BadRequestError(f"{option} {text!r}: expected positive numbers, separated by commas")
    return numbers
