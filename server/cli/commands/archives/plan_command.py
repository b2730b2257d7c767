"""`solidcloud plan`: estimate the cost of a build without running it."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ..command_options import AsJson, interruptible, parse_bytes, print_json, print_warning

if TYPE_CHECKING:
    from .....builder.plan.build_plan import BuildPlan, Limit


def plan(
    scans: Annotated[
        list[Path] | None, typer.Argument(help="Scans, folders of scans, or a scans.toml; or give --points.")
    ] = None,
    points: Annotated[
        str | None, typer.Option(help="Instead of scans: a number of points, such as 1e9 or 1000000000.")
    ] = None,
    density: Annotated[
        float | None,
        typer.Option(help="With --points: points per square metre of surface; default: that of make facade."),
    ] = None,
    number_of_scans: Annotated[
        int | None,
        typer.Option(
            "--scans", min=1, help="With --points: number of scans; default: one per 1.4 million points."
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option("-o", "--output", help="Folder of the archive, to check the free space of its disk."),
    ] = Path("."),
    voxel: Annotated[float, typer.Option(help="Edge of a voxel [m].")] = 8.0,
    resolution: Annotated[float | None, typer.Option(help="Lattice step [m].")] = None,
    jobs: Annotated[int, typer.Option(help="Worker processes; 0: one per core.")] = 0,
    memory: Annotated[str, typer.Option(help="Memory bound of the build, all processes together.")] = "2GB",
    keep: Annotated[
        str,
        typer.Option(help="Columns to keep, separated by commas: scan, intensity, rgb, classification."),
    ] = "",
    skip_bad: Annotated[bool, typer.Option("--skip-bad", help="Leave out broken scans.")] = False,
    measure: Annotated[
        bool,
        typer.Option(
            "--measure", help="First measure the speed of this machine for a few seconds, and use it."
        ),
    ] = False,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Read few points and compress none: the archive's size is a rough estimate, printed as a range.",
        ),
    ] = False,
    as_json: AsJson = False,
) -> None:
    """Estimate the cost of a build.

    Prints bytes, memory, time by stage, and the limits that would stop the build.
    """
    from .....builder.config import BuildConfig
    from .....builder.plan.build_plan import estimate, hypothetical_scene
    from .....builder.plan.rates import load_rates
    from .....schemas.errors import BadRequestError
    from ...output.progress_display import progress_listener

    if bool(scans) == (points is not None):
        raise BadRequestError("expected either scans or --points with a number")
    if points is None and (density is not None or number_of_scans is not None):
        raise BadRequestError("--density and --scans need --points: with scans, both are measured")
    if density is not None and not 0 < density < math.inf:
        raise BadRequestError(f"--density {density}: expected a positive number of points per square metre")
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
        from .....builder.plan.measure_rates import measure_rates

        with interruptible(), progress_listener() as bars:
            rates = measure_rates(rates, bars)
    if points is not None:
        found = estimate(
            hypothetical_scene(_number(points), rates, density, number_of_scans), config, rates, output
        )
    else:
        from .....builder.plan.scan_sample import plan_build

        found = plan_build(scans or [], config, output, rates, quick=quick)
    print_plan(found, as_json)


def print_plan(plan: "BuildPlan", as_json: bool) -> None:
    """Print a plan, and its warnings on standard error."""
    from ...output.console import print_facts

    if as_json:
        print_json(plan.as_json())
    else:
        print_facts(plan_facts(plan))
    for warning in plan.warnings:
        print_warning(warning)


def _number(text: str) -> int:
    """Parse a number of points, such as 1e9 or 1_000_000. Raises BadRequestError if invalid."""
    from .....schemas.errors import BadRequestError

    try:
        value = int(float(text))
    except (ValueError, OverflowError):
        value = 0
    if not 1 <= value <= 10**15:
        raise BadRequestError(f"--points {text!r}: expected a number, 1 to 1e15")
    return value


def plan_facts(plan: "BuildPlan") -> Iterator[tuple[str, str]]:
    """Yield the names and values that describe a plan."""
    from ...output.console import bytes_text

    yield "points", f"{plan.points:,} of {plan.scans:,} scans, {plan.density:,.0f} per square metre"
    yield (
        "archive",
        f"{bytes_text(plan.archive_bytes)}, {plan.bytes_a_point:.2f} bytes per point at "
        f"{plan.lattice_step * 1e3:g} mm; {plan.shards:,} shards; "
        f"from {bytes_text(plan.archive_bytes / plan.archive_within)} to "
        f"{bytes_text(plan.archive_bytes * plan.archive_within)}",
    )
    yield (
        "voxels",
        f"{plan.voxels:,} of {plan.points_a_voxel:,.0f} points; index {bytes_text(plan.index_bytes)}",
    )
    yield "preview", f"{bytes_text(plan.preview_bytes)} beside it, for ParaView"
    yield (
        "disk",
        f"{bytes_text(plan.disk_bytes)} during the build, of which {bytes_text(plan.spool_bytes)} are the spool",
    )
    yield "memory", f"{bytes_text(plan.memory_bytes)}, including {plan.jobs} worker processes"
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
    """Format a limit, with advice if it binds."""
    from ...output.console import bytes_text

    found, most = (
        bytes_text(value) if limit.unit == "bytes" else f"{value:,.0f}" for value in (limit.found, limit.most)
    )
    return f"{limit.what}: {found} of {most}" + (f": {limit.advice}" if limit.binds else "")


def time_text(seconds: float) -> str:
    """Format a duration: 0.4 s, 90 s, 12 min, 5.1 h, 3.2 days."""
    for most, divisor, unit in ((120, 1, "s"), (120 * 60, 60, "min"), (48 * 3600, 3600, "h")):
        if seconds < most:
            value = seconds / divisor
            return f"{value:.1f} {unit}" if value < 10 else f"{value:.0f} {unit}"
    return f"{seconds / 86400:,.1f} days"
