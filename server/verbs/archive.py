"""`solidcloud info`, `validate`: what an archive holds, and whether it is whole."""

from typing import Annotated

import typer

from .options import ArchivePath, AsJson, complain, print_json


def info(archive: ArchivePath, as_json: AsJson = False) -> None:
    """Say what an archive holds."""
    import msgspec

    from ...schemas.index import radius_distribution
    from ..console import print_info
    from ..scene import describe
    from ..store import Store

    store = Store(archive)
    found = describe(store, archive.resolve().name)
    classes = radius_distribution(store.archive.header)
    store.close()
    if as_json:
        print_json({**msgspec.to_builtins(found), "radius_classes": msgspec.to_builtins(classes)})
    else:
        print_info(found, classes)


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
    from ...builder.verify import verify_archive
    from ..progress import progress_listener

    with progress_listener() as bars:
        report = verify_archive(archive, deep=deep, exact=exact, sample=sample, progress=bars)
    if as_json:
        print_json(report._asdict())
    else:
        proved = f", {report.exact_nodes:,} of {report.nodes:,} bounds proved" if exact else ""
        counted = f"{report.voxels:,} voxels, {report.points:,} points{proved}"
        print(f"{archive}: {counted}, {len(report.faults)} faults")
    for fault in report.faults:
        complain(fault, 3)
    raise typer.Exit(3 if report.faults else 0)
