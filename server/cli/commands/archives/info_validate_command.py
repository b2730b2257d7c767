"""`solidcloud info` and `validate`: describe and check an archive."""

from typing import Annotated

import typer

from ..command_options import ArchivePath, AsJson, print_error, print_json


def info(archive: ArchivePath, as_json: AsJson = False) -> None:
    """Describe an archive: scans, points, size.

    Ends with what matters: points, area, spacing, radius, voxel size, and what to look at if it
    looks wrong.
    """
    import msgspec

    from .....builder.passes.archive_summary import summarize_archive
    from .....schemas.archive.radius_model import radius_distribution
    from ....archives.scene_info import describe
    from ....residency.voxel_store import VoxelStore
    from ...output.archive_facts import archive_details, detail_facts, print_summary
    from ...output.console import print_info

    store = VoxelStore(archive)
    found = describe(store, archive.resolve().name)
    header = store.archive.header
    classes = radius_distribution(header.models, header.radius_counts, header.radius_capped)
    details, summary = archive_details(store), summarize_archive(store.archive)
    store.close()
    if as_json:
        described = {**msgspec.to_builtins(found), "radius_classes": msgspec.to_builtins(classes), **details}
        print_json({**described, "summary": summary.as_json()})
    else:
        print_info(found, classes, detail_facts(details))
        print_summary(summary)


def validate(
    archive: ArchivePath,
    deep: Annotated[bool, typer.Option("--deep", help="Also compute every bound again.")] = False,
    exact: Annotated[
        bool, typer.Option("--exact", help="Also prove bounds in exact integer arithmetic.")
    ] = False,
    sample: Annotated[
        int | None,
        typer.Option(help="With --exact: prove only this number of bounds, spread over the archive."),
    ] = None,
    jobs: Annotated[
        int, typer.Option(min=0, help="Worker processes; 0: one per core, fewer for a small archive.")
    ] = 0,
    as_json: AsJson = False,
) -> None:
    """Check every record of an archive. Exit code 3 if one is broken."""
    from .....builder.passes.verify import verify_archive, verify_jobs
    from .....builder.run.executor import ProcessExecutor
    from ...output.progress_display import progress_listener

    jobs = verify_jobs(archive, jobs, deep=deep, exact=exact)
    with progress_listener() as bars, ProcessExecutor(jobs) as executor:
        report = verify_archive(
            archive, deep=deep, exact=exact, sample=sample, progress=bars, executor=executor
        )
    if as_json:
        print_json(report._asdict())
    else:
        proved = f", {report.exact_nodes:,} of {report.nodes:,} bounds proved" if exact else ""
        counted = f"{report.voxels:,} voxels, {report.points:,} points{proved}"
        print(f"{archive}: {counted}, {len(report.faults)} faults")
        for note in report.notes:
            print(f"note: {note}")
    for fault in report.faults:
        print_error(fault, 3)
    raise typer.Exit(3 if report.faults else 0)
