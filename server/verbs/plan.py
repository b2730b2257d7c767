"""`solidcloud plan`: what a build will take, before it is begun."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from .interrupt import interruptible
from .options import AsJson, parse_bytes, print_json

if TYPE_CHECKING:
    from ...builder.plan import Limit, Plan


def plan(
    scans: Annotated[
        list[Path] | None, typer.Argument(help="Scans, folders of scans, or a scans.toml; or give --points.")
    ] = None,
    points: Annotated[
        str | None, typer.Option(help="Instead of scans: a number of points, such as 1e9 or 1000000000.")
    ] = None,
    density: Annotated[
        float | None, typer.Option(help="With --points: points a square metre of surface; else a façade's.")
    ] = None,
    number_of_scans: Annotated[
        int | None,
        typer.Option("--scans", min=1, help="With --points: scans; else of 1.4 million points each."),
    ] = None,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Where the archive would go: for the room on its disk.")
    ] = Path("."),
    voxel: Annotated[float, typer.Option(help="Edge of a voxel [m].")] = 8.0,
    resolution: Annotated[float | None, typer.Option(help="Lattice step [m].")] = None,
    jobs: Annotated[int, typer.Option(help="Worker processes; 0: one a core.")] = 0,
    memory: Annotated[str, typer.Option(help="What the build may hold in memory.")] = "2GB",
    keep: Annotated[str, typer.Option(help="Columns to keep: scan, intensity, normal, by comma.")] = "",
    skip_bad: Annotated[bool, typer.Option("--skip-bad", help="Leave out broken scans.")] = False,
    measure: Annotated[
        bool, typer.Option("--measure", help="Measure this machine first, some seconds, and go by that.")
    ] = False,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick", help="Look at few points and pack none: bytes are a guess, and a range is said."
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Estimate what a build takes: bytes, memory, time by stage, and the limits that would stop it."""
    from ...builder.config import BuildConfig
    from ...builder.plan import estimate, imagined, load_rates
    from ...schemas.errors import BadRequestError
    from ..console import print_facts
    from ..progress import progress_listener

    if bool(scans) == (points is not None):
        raise BadRequestError("expected scans to look at, or --points and a number, one of them")
    if points is None and (density is not None or number_of_scans is not None):
        raise BadRequestError("--density and --scans go with --points: scans say themselves")
    if density is not None and not 0 < density < math.inf:
        raise BadRequestError(f"--density {density}: expected a positive number of points a square metre")
    config = BuildConfig(
        voxel=voxel,
        resolution=resolution,
        jobs=jobs,
        memory_bytes=parse_bytes(memory, "--memory"),
        keep=frozenset(filter(None, keep.split(","))),
        skip_bad=skip_bad,
    )
    rates = load_rates()
    if measure:
        from ...builder.measure import measured

        with interruptible(), progress_listener() as bars:
            rates = measured(rates, bars)
    if points is not None:
        found = estimate(imagined(_number(points), rates, density, number_of_scans), config, rates, output)
    else:
        from ...builder.sample import planned

        found = planned(scans or [], config, output, rates, quick=quick)
    if as_json:
        print_json(found.as_json())
    else:
        print_facts(plan_facts(found))


def _number(text: str) -> int:
    """A number of points, as 1e9 or 1_000_000; BadRequestError for anything else."""
    from ...schemas.errors import BadRequestError

    try:
        value = int(float(text))
    except (ValueError, OverflowError):
        value = 0
    if not 1 <= value <= 10**15:
        raise BadRequestError(f"--points {text!r}: expected a number, 1 to 1e15")
    return value


def plan_facts(plan: "Plan") -> Iterator[tuple[str, str]]:
    """What a plan says, for people."""
    from ..console import bytes_text

    yield "points", f"{plan.points:,} of {plan.scans:,} scans, {plan.density:,.0f} on a square metre"
    yield (
        "archive",
        f"{bytes_text(plan.archive_bytes)}, {plan.bytes_a_point:.2f} bytes a point at {plan.lattice_step * 1e3:g} mm; "
        f"{plan.shards:,} shards; from {bytes_text(plan.archive_bytes / plan.archive_within)} to "
        f"{bytes_text(plan.archive_bytes * plan.archive_within)}",
    )
    yield (
        "voxels",
        f"{plan.voxels:,} of {plan.points_a_voxel:,.0f} points; index {bytes_text(plan.index_bytes)}",
    )
    yield "preview", f"{bytes_text(plan.preview_bytes)} beside it, for ParaView"
    yield (
        "disk",
        f"{bytes_text(plan.disk_bytes)} while it is built, {bytes_text(plan.spool_bytes)} of it the spool",
    )
    yield "memory", f"{bytes_text(plan.memory_bytes)}, {plan.jobs} jobs and all"
    stages = ", ".join(f"{name} {time_text(seconds)}" for name, seconds in plan.stages.items())
    rate = plan.points / plan.seconds
    yield "time", f"{time_text(plan.seconds)} ({stages}), {rate:,.0f} points/s"
    for line in plan.rests_on:
        yield "rests on", line
    for line in plan.assumed:
        yield "assumed", line
    for limit in plan.limits:
        yield "limit" if not limit.binds else "BINDS", _limit_text(limit)


def _limit_text(limit: "Limit") -> str:
    """A limit, and what to do where it binds."""
    from ..console import bytes_text

    found, most = (
        bytes_text(value) if limit.unit == "bytes" else f"{value:,.0f}" for value in (limit.found, limit.most)
    )
    return f"{limit.what}: {found} of {most}" + (f": {limit.advice}" if limit.binds else "")


def time_text(seconds: float) -> str:
    """A time for people: 0.4 s, 90 s, 12 min, 5.1 h, 3.2 days."""
    for most, divisor, unit in ((120, 1, "s"), (120 * 60, 60, "min"), (48 * 3600, 3600, "h")):
        if seconds < most:
            value = seconds / divisor
            return f"{value:.1f} {unit}" if value < 10 else f"{value:.0f} {unit}"
    return f"{seconds / 86400:,.1f} days"
