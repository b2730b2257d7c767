"""Description of a build in its journal: software, options and scans.

A build resumes only if its description is unchanged. Otherwise an error names the differences.
"""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ...schemas.archive.archive import Archive
from ...schemas.archive.index import Source
from ...schemas.errors import BadRequestError, FormatError
from ..config import BuildConfig
from ..run.software_versions import software_versions
from ..sources.common.scan import BEYOND, NOT_FINITE, Scan, sha256_of
from ..sources.scan_files import InputFile

# Most differences that a message names.
NAMED = 5

# Fields of a scan's entry that define its placement -> name in messages.
_PLACED = {"pose": "pose", "crs": "coordinate system", "units": "unit", "up": "direction up"}

# Options whose stored name differs from the command line, or that the command line lacks.
_OPTION_NAMES = {"models": "--radius", "with_slab": "with_slab"}


def describe_build(inputs: Sequence[InputFile], config: BuildConfig) -> dict[str, Any]:
    """Return the software, options and inputs of a build, as a JSON value.

    Memory and jobs are not included.
    """
    return {
        "software": software_versions(),
        "options": {**config.identity(), "strict": config.strict, "skip_bad": config.skip_bad},
        "inputs": [
            entry for item in sorted(inputs, key=lambda item: str(item.path)) for entry in _entries(item)
        ],
    }


def _entries(item: InputFile) -> list[dict[str, Any]]:
    """Return the entries of a file: its size and time, and for each of its scans the placement."""
    try:
        status = item.path.stat()
        file = {"path": str(item.path), "bytes": status.st_size, "changed_ns": status.st_mtime_ns}
    except OSError:
        file = {"path": str(item.path), "bytes": -1, "changed_ns": -1}
    if not item.scans:
        return [{**file, "scan": 0, **dict.fromkeys(_PLACED, "")}]
    return [{**file, "scan": scan.index, **_placed(scan)} for scan in item.scans]


def _placed(scan: Scan | Source) -> dict[str, Any]:
    """Return the placement of a scan, or of a source of an archive, in the world."""
    return {"pose": scan.pose.tolist(), "crs": scan.crs, "units": scan.units, "up": scan.up}


def check_same(folder: Path, was: Mapping[str, Any], now: Mapping[str, Any]) -> None:
    """Raise BadRequestError unless the build begun in `folder` is the requested one.

    The error names the differences.
    """
    if was.get("software") != now["software"]:
        found, here = was.get("software", {}), now["software"]
        names = sorted(name for name in {*found, *here} if found.get(name) != here.get(name))
        differ = [f"{name} {found.get(name, 'none')}, now {here.get(name, 'none')}" for name in names]
        raise BadRequestError(
            f"{folder}: this build was begun with other software: {_listed(differ)}: use that software, or "
            "give --fresh to start over"
        )
    options, remedies = _option_differences(was["options"], now["options"])
    inputs = _input_differences(was["inputs"], now["inputs"])
    if not options and not inputs:
        return
    remedies += ["the same scans as they were"] if inputs else []
    raise BadRequestError(
        f"{folder}: another build was begun here: {_listed(options + inputs)}: give {_listed(remedies)} to resume it, "
        "or --fresh to start over"
    )


def changed_inputs(inputs: Sequence[InputFile], config: BuildConfig, what: Mapping[str, Any]) -> str:
    """Return a text listing the inputs that changed since `what` was described, or ""."""
    return _listed(_input_differences(what["inputs"], describe_build(inputs, config)["inputs"]))


def _option_differences(was: Mapping[str, Any], now: Mapping[str, Any]) -> tuple[list[str], list[str]]:
    """Return the differences, and the options that would resume the build."""
    differ, give = [], []
    for name in sorted({*was, *now}):
        before, after = was.get(name), now.get(name)
        if before == after:
            continue
        option = _OPTION_NAMES.get(name, f"--{name.replace('_', '-')}")
        differ.append(f"{option} was {_value(before)}, is {_value(after)}")
        unset = before in (None, False, "")
        give.append(f"no {option}" if unset else option if before is True else f"{option} {before}")
    return differ, give


def _value(value: Any) -> str:
    """Return the value of an option for a message."""
    if value is True:
        return "given"
    return "not given" if value in (None, False, "") else str(value)


def _input_differences(was: list[dict[str, Any]], now: list[dict[str, Any]]) -> list[str]:
    """Return which scans were added, are missing, or changed."""
    before, after = ({(e["path"], e["scan"]): e for e in entries} for entries in (was, now))
    differ = []
    for key in sorted({*before, *after}):
        name = key[0] if key[1] == 0 else f"{key[0]} scan {key[1]}"
        if key not in before:
            differ.append(f"{name} is new")
        elif key not in after:
            differ.append(f"{name} is missing")
        elif before[key]["bytes"] != after[key]["bytes"]:
            differ.append(f"{name} had {before[key]['bytes']} bytes, has {after[key]['bytes']}")
        elif before[key] != after[key]:
            names = {"changed_ns": "time", **_PLACED}
            what = [text for field, text in names.items() if before[key].get(field) != after[key].get(field)]
            differ.append(f"{name} has another {' and '.join(what)}")
    return differ


def _listed(items: list[str]) -> str:
    """Join some items for a message."""
    more = len(items) - NAMED
    return "; ".join(items[:NAMED]) + (f"; and {more} more" if more > 0 else "")


def is_up_to_date(
    target: Path,
    inputs: Sequence[InputFile],
    config: BuildConfig,
    tick: Callable[[int], None] = lambda _: None,
) -> bool:
    """Return whether `target` is already the archive of these scans (by SHA-256) and options.

    tick: receives the bytes of each file that is hashed. No file is hashed if a cheaper check finds
    a difference.
    """
    try:
        with Archive(target) as archive:
            header = archive.header
    except FormatError:
        return False
    sources = header.sources
    lost = any(s.fault for s in sources) and not config.skip_bad
    unclean = any({NOT_FINITE, BEYOND} & set(s.skipped) for s in sources) and config.strict
    if not config.is_identity(header.options) or header.generation or lost or unclean:
        return False
    asked = {
        (str(item.path), scan.index if scan else 0): scan
        for item in inputs
        for scan in (item.scans or [None])  # type: ignore[list-item]
    }
    if {(s.path, s.index) for s in sources} != set(asked) or len(sources) != len(asked):
        return False
    for s in sources:
        scan = asked[s.path, s.index]
        if (scan is None) != (not s.format) or (scan and not s.fault and _placed(scan) != _placed(s)):
            return False
    hashes: dict[str, str] = {}
    for s in sources:
        path = Path(s.path)
        if asked[s.path, s.index] is not None and s.path not in hashes:
            hashes[s.path] = sha256_of(path)
            tick(path.stat().st_size)
        if hashes.get(s.path, "") != s.sha256:
            return False
    return True
