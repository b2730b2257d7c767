"""Checks of the installation: Python, the command, the libraries and the optional extras."""

import platform
import re
import sys
from collections.abc import Iterator
from importlib import metadata

from ....schemas.runtime.own_command import NAME, own_command, path_advice
from .check import Check, Status, fine

# What each optional extra of pyproject.toml is for; the extras for development are left out.
EXTRAS = {
    "readers": "reads LAS, LAZ, E57, PLY and meshes",
    "made": "generates test scans",
    "report": "draws the charts of accuracy",
    "cluster": "builds on dask workers",
    "metrics": "serves Prometheus metrics",
    "view": "walks through a scene in the browser",
}
_REQUIREMENT = re.compile(r"(?P<name>[\w.-]+)(?:\[[\w,]+\])?(?P<versions>[^;]*)(?:;(?P<marker>.*))?")
_COMPARE = re.compile(r"(>=|<=|==|<|>)\s*([\d.]+)")


def check_python() -> Iterator[Check]:
    """Check Python and report the version of this package."""
    yield fine(NAME, f"{metadata.version(NAME)}, {metadata.distribution(NAME).locate_file(NAME)}")
    found = f"{platform.python_version()} ({platform.python_implementation()}), {sys.executable}"
    yield fine("python", f"{found}, on {platform.platform()}")


def check_command() -> Iterator[Check]:
    """Check that a shell finds the command."""
    if advice := path_advice():
        text = f"{NAME} is not on the search path: run it as {own_command()}"
        yield Check("command", Status.NOTE, text, advice.splitlines()[-1].strip())
    else:
        yield fine("command", f"{NAME} is on the search path")


def check_libraries() -> Iterator[Check]:
    """Check that every required library has a version that this package works with."""
    built_with = _inner_versions()
    for name, versions in requirements().get("", []):
        found = _installed(name)
        inner = f" ({built_with[name]})" if name in built_with else ""
        reinstall = f"pip install '{name}{versions}'"
        if found is None:
            yield Check(name, Status.FAULT, f"not installed, expected {versions}", reinstall)
        elif not _fits(found, versions):
            yield Check(name, Status.FAULT, f"{found}{inner}, expected {versions}", reinstall)
        elif "not usable" in inner:
            yield Check(
                name, Status.FAULT, f"{found}{inner}", f"pip install --force-reinstall '{name}{versions}'"
            )
        else:
            yield fine(name, f"{found}{inner}")


def check_extras() -> Iterator[Check]:
    """Report which optional extras are installed."""
    required = requirements()
    for extra, purpose in EXTRAS.items():
        found = [(name, versions, _installed(name)) for name, versions in required.get(extra, [])]
        missing = [name for name, _, version in found if version is None]
        old = [
            f"{name} {version}"
            for name, versions, version in found
            if version and not _fits(version, versions)
        ]
        name, install = f"extra {extra}", f"pip install '{NAME}[{extra}]'"
        if missing:
            yield Check(name, Status.NOTE, f"{purpose}: not installed: {', '.join(missing)}", install)
        elif old:
            yield Check(name, Status.WARNING, f"{purpose}: too old or too new: {', '.join(old)}", install)
        else:
            yield fine(name, f"{purpose}: {', '.join(f'{name} {version}' for name, _, version in found)}")


def requirements() -> dict[str, list[tuple[str, str]]]:
    """Return the required libraries and their versions, by extra; "" for those always required."""
    found: dict[str, list[tuple[str, str]]] = {}
    for line in metadata.requires(NAME) or ():
        match = _REQUIREMENT.match(line)
        if match is None or match["name"] == NAME:
            continue
        extra = re.search(r"""extra\s*==\s*['"]([\w-]+)['"]""", match["marker"] or "")
        found.setdefault(extra[1] if extra else "", []).append(
            (match["name"], match["versions"].strip().strip("()"))
        )
    return found


def _installed(name: str) -> str | None:
    """Return the installed version of a library, None if it is not installed."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def _inner_versions() -> dict[str, str]:
    """Return the versions of what some libraries wrap, by library."""
    found = {}
    if llvmlite := _installed("llvmlite"):
        found["numba"] = f"llvmlite {llvmlite}"
    try:
        from ....schemas.runtime.new_hdf5_file import hdf5_version

        found["h5py"] = f"HDF5 {hdf5_version()}"
    except (ImportError, OSError) as error:
        found["h5py"] = f"not usable: {error}"
    try:
        from ....schemas.archive.zstd_frame import zstd_version

        found["zstandard"] = f"zstd {zstd_version()}"
    except (ImportError, OSError) as error:
        found["zstandard"] = f"not usable: {error}"
    return found


def _fits(version: str, wanted: str) -> bool:
    """Return whether a version satisfies all of the comparisons, such as ">=0.68,<0.69"."""
    found = _numbers(version)
    for compare, text in _COMPARE.findall(wanted):
        limit = _numbers(text)
        holds = {
            ">=": found >= limit,
            "<=": found <= limit,
            "==": found == limit,
            "<": found < limit,
            ">": found > limit,
        }
        if not holds[compare]:
            return False
    return True


def _numbers(version: str) -> tuple[int, ...]:
    """Return the numbers at the beginning of a version, without zeros at the end."""
    match = re.match(r"\d+(?:\.\d+)*", version)
    numbers = [int(part) for part in match[0].split(".")] if match else []
    while numbers and not numbers[-1]:
        numbers.pop()
    return tuple(numbers)
