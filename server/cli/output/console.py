"""Terminal output of results, on standard output; `progress_display.py` shows running work."""

from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

from rich.table import Table

from ....schemas.runtime.own_command import with_own_command
from .terminal import Terminal

if TYPE_CHECKING:
    # These modules load numba and HDF5; a table needs neither.
    from ....builder.pipeline import BuildSummary
    from ....schemas.archive.radius_model import RadiusDistribution
    from ....schemas.wire.scene_messages import SceneInfo


def print_facts(facts: Iterable[tuple[str, str]]) -> None:
    """Print names and values in two columns. Commands are written as a shell can run them."""
    table = Table(show_header=False, box=None, pad_edge=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for name, value in facts:
        table.add_row(name, with_own_command(value))
    Terminal().print(table)


def print_build(summary: "BuildSummary") -> None:
    """Print the summary of a completed build."""
    print_facts(_build_facts(summary))


def print_info(
    found: "SceneInfo",
    classes: "RadiusDistribution | None" = None,
    more: Iterable[tuple[str, str]] = (),
) -> None:
    """Print the facts about an archive.

    classes: the distribution of its points' radius classes, None if it stores none.
    more: additional names and values.
    """
    print_facts((*_info_facts(found), *more, *(_class_facts(classes, found.points) if classes else ())))


def bytes_text(count: float) -> str:
    """Format a number of bytes: 1536 -> "1.5 kB". Units are powers of 1024, as in the options."""
    for unit in ("bytes", "kB", "MB"):
        if count < 1024:
            return f"{count:.0f} bytes" if unit == "bytes" else f"{count:.1f} {unit}"
        count /= 1024
    return f"{count:,.1f} GB"


def length_text(metres: float) -> str:
    """Format a small length in millimetres. Below one picometre (rounding error) it prints as 0."""
    return f"{metres * 1e3 if metres >= 1e-12 else 0.0:.4g} mm"


def _build_facts(summary: "BuildSummary") -> Iterator[tuple[str, str]]:
    each = summary.bytes / max(summary.points, 1)
    rate = summary.points / max(summary.seconds, 1e-9)
    stages = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in summary.stages.items())
    yield "archive", f"{summary.archive}, {bytes_text(summary.bytes)}, {each:.2f} bytes per point"
    if summary.preview_bytes:
        yield "preview", f"preview.vtkhdf for ParaView, {bytes_text(summary.preview_bytes)}"
    if summary.level_bytes:
        share = summary.level_bytes / max(summary.bytes, 1)
        yield "level", f"level of detail, {bytes_text(summary.level_bytes)}, {share:.1%} of the archive"
    yield "points", f"{summary.points:,} in {summary.voxels:,} voxels, {summary.shards} shards"
    for name, count in summary.columns.items():
        yield name, f"of {count:,} points" + ("" if count == summary.points else ", zeros for the others")
    yield (
        "lattice",
        (
            f"step {length_text(summary.lattice_step)} ({summary.lattice_source}), "
            f"no point moved farther than {length_text(summary.moved_max)} along an axis"
        ),
    )
    yield "radius", f"{length_text(summary.radius)}, standard error {length_text(summary.radius_error)}"
    for reason, count in summary.skipped.items():
        yield "left out", f"{count:,} points: {reason}"
    yield "time", f"{summary.seconds:.1f} s ({stages}), {rate:,.0f} points/s"


def _class_facts(classes: "RadiusDistribution", points: int) -> Iterator[tuple[str, str]]:
    """Yield a histogram of the local radii, the number of capped points and of points on a rim."""
    most = max((held.points for held in classes.local), default=0)
    for held in classes.local:
        bar = "█" * round(30 * held.points / most) or "▏"
        yield f"local {length_text(held.radius)}", f"{held.points:>13,} {held.points / points:>6.1%} {bar}"
    if classes.capped is not None:
        yield (
            "local capped",
            f"{classes.capped:>13,} {classes.capped / points:>6.1%} with too few near neighbours",
        )
    if classes.rim is not None:
        yield "border", f"{classes.rim:>13,} {classes.rim / points:>6.1%} on the rim of a surface"


def _info_facts(found: "SceneInfo") -> Iterator[tuple[str, str]]:
    (x0, y0, z0), (x1, y1, z1) = found.bounds
    step, moved = length_text(found.lattice_step), length_text(found.moved_max)
    radius, error = length_text(found.radius), length_text(found.radius_error)
    generation = f", generation {found.generation}" if found.generation else ""
    yield "scene", f"{found.scene}, format {found.format_version}{generation}"
    yield "points", f"{found.points:,} in {found.voxels:,} voxels of {found.voxel_size:g} m"
    yield "bounds", f"{x0:.3f} {y0:.3f} {z0:.3f} .. {x1:.3f} {y1:.3f} {z1:.3f} m"
    yield "lattice", f"step {step} ({found.lattice_source}), points moved up to {moved} along an axis"
    yield (
        "radius",
        (f"{radius} ({found.radius_model}), standard error {error}, of {found.radius_sample:,} points"),
    )
    if found.radius_now is not None:
        change = 100 * (found.radius_now / found.radius - 1) if found.radius else 0.0
        yield (
            "radius now",
            f"{length_text(found.radius_now)} ({change:+.1f} %), measured on the present points",
        )
    yield "hierarchy", f"degree {found.degree}, up to {found.leaf} points per leaf node"
    yield "size", f"{bytes_text(found.record_bytes)} of records, {bytes_text(found.resident_bytes)} decoded"
    for number, source in enumerate(found.sources):
        if source.fault:
            continue
        left_out = "".join(f", {count:,} {reason} left out" for reason, count in source.skipped.items())
        yield (
            f"scan {number}",
            f"{source.path} [{source.index}], {source.format}, {source.count:,} points{left_out}",
        )
    for fault in found.skipped:
        yield "left out", fault
    for low, high in found.unknown:
        yield "unknown", f"{' '.join(f'{v:.3f}' for v in low)} .. {' '.join(f'{v:.3f}' for v in high)} m"
    if found.unknown_everywhere:
        yield "unknown", "everywhere: a scan was left out whose bounds are not known"
