"""Small build that writes many files, its undisturbed archive, and the checks after it was stopped."""

import hashlib
import importlib
import pkgutil
import shutil
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import solidcloud.builder
from solidcloud.builder.passes.verify import verify_archive
from solidcloud.schemas.archive.index import INDEX_NAME
from solidcloud.schemas.archive.level import LEVEL_FOLDER
from solidcloud.schemas.archive.vtkhdf import PREVIEW_NAME
from solidcloud.schemas.errors import SolidcloudError

# Limits that divide a build into units, reduced: about 10 units of a few hundred points, a shard of
# a quarter of SHARD_POINTS.
SMALL: dict[str, Any] = {"SHARD_POINTS": 3200, "RANGE_POINTS": (1500, 1500), "MIN_RUN_POINTS": 700}
POINTS = 4000
VOXEL = 1.0
NAME = "hall"


def make_small() -> list[str]:
    """Set the constants of SMALL wherever the builder's modules hold them; return where.

    Call it once in each process.
    """
    for module in pkgutil.walk_packages(solidcloud.builder.__path__, "solidcloud.builder."):
        if (
            not module.name.endswith((".dask_cluster", ".las_export")) and ".made" not in module.name
        ):  # loads dask
            importlib.import_module(module.name)
    found = []
    for name, module in sorted(sys.modules.items()):
        if name.startswith("solidcloud.builder."):
            for constant in SMALL.keys() & vars(module).keys():
                setattr(module, constant, SMALL[constant])
                found.append(f"{name}.{constant}")
    missing = SMALL.keys() - {where.rpartition(".")[2] for where in found}
    if missing:
        raise RuntimeError(f"no {', '.join(missing)} in the builder: what cuts a build into units now?")
    return found


def write_scans(folder: Path) -> None:
    """Write two scans of a room of 4 m, one LAS, one text, with some points in common."""
    rng = np.random.default_rng(5)
    floor = np.column_stack([rng.uniform(0, 4, (POINTS // 2, 2)), rng.normal(0, 0.002, POINTS // 2)])
    wall = np.column_stack(
        [rng.uniform(0, 4, POINTS // 4), rng.normal(2, 0.002, POINTS // 4), rng.uniform(0, 2.5, POINTS // 4)]
    )
    points = np.round(np.concatenate([floor, wall]), 4)
    folder.mkdir(parents=True)
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales = np.full(3, 1e-4)
    with laspy.open(folder / "a.las", "w", header=header) as file:
        record = laspy.ScaleAwarePointRecord.zeros(len(points), header=header)
        record.x, record.y, record.z = points.T
        file.write_points(record)
    more = np.concatenate([points[: POINTS // 8], np.round(rng.uniform(0, 3, (POINTS // 8, 3)), 4)])
    np.savetxt(folder / "b.xyz", more, fmt="%.4f")


def content(folder: Path) -> dict[str, str]:
    """Return the content of a folder: path below it -> SHA-256."""
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


class Case:
    """One target to build, and the archive it must become.

    folder: empty except for what a build leaves.
    target: in the folder.
    old: content of a previous archive there, {} for none.
    """

    def __init__(self, folder: Path, scans: Path, reference: dict[str, str], jobs: int = 1) -> None:
        self.folder, self.scans, self.reference, self.jobs = folder, scans, reference, jobs
        self.target = folder / NAME
        self.old: dict[str, str] = {}
        folder.mkdir(parents=True)

    def put_old(self, archive: Path) -> None:
        """Copy another archive to the target, to be replaced."""
        shutil.copytree(archive, self.target)
        self.old = content(archive)

    def arguments(self) -> list[str]:
        """Return the command's arguments."""
        more = ["--overwrite"] if self.old else []
        return arguments(self.scans, self.target, self.jobs) + more

    def visible(self) -> list[str]:
        """Return the faults of whatever the requested name shows; the build may be at any stage."""
        aside = self.folder / f".{NAME}.old"
        if self.target.exists():
            found = content(self.target)
            if found not in (self.reference, self.old or self.reference):
                return [
                    f"{self.target}: neither the new archive nor the old: {difference(found, self.reference)}"
                ]
        elif self.old and not (aside.exists() and content(aside) == self.old):
            return [f"{self.target}: the old archive is gone, and the new one is not there"]
        return []

    def whole(self) -> bool:
        """Return whether the archive is complete, every byte of it."""
        return self.target.exists() and content(self.target) == self.reference

    def finished(self) -> list[str]:
        """Return the faults after a build that reported success."""
        faults = []
        if not self.whole():
            found = content(self.target) if self.target.exists() else {}
            faults.append(f"{self.target}: not byte-identical: {difference(found, self.reference)}")
        else:
            faults += self._valid()
        left = sorted(path.name for path in self.folder.iterdir() if path != self.target)
        if left:
            faults.append(f"{self.folder}: left behind: {', '.join(left)}")
        return faults

    def _valid(self) -> list[str]:
        """Return the faults that `validate` finds in the archive."""
        try:
            return [f"{self.target}: {fault}" for fault in verify_archive(self.target).faults]
        except SolidcloudError as error:
            return [str(error)]

    def stage(self) -> str:
        """Return how far a stopped build came, judged by the files it left."""
        work = self.folder / f".{NAME}.building"
        if (self.folder / f".{NAME}.old").exists():
            return "between two renames"
        if not work.exists():
            return "published" if self.whole() else "nothing"
        for name, pattern in (
            ("index", "*/archive/index.h5"),
            ("shards", "*/archive/shards/*.h5"),
            ("spool", "*/spool/*"),
            ("survey", "*/survey/*"),
        ):
            if any(work.glob(pattern)):
                return name
        return "started"


class Change(Case):
    """One archive that a scan is added to.

    It is the old archive or the new one, with or without files that it does not name.
    scans: the one that is added.
    """

    def __init__(self, folder: Path, scan: Path, before: Path, reference: dict[str, str]) -> None:
        super().__init__(folder, scan, reference)
        self.put_old(before)

    def arguments(self) -> list[str]:
        """Return the command's arguments."""
        return ["add", str(self.target), str(self.scans), "--jobs", "1"]

    def visible(self) -> list[str]:
        """Return the faults of the archive, at any moment."""
        found = content(self.target)
        for whole in (self.old, self.reference):
            # Preview and level are replaced later; each states the archive it belongs to.
            if {name: whole[name] for name in whole if not _is_derived(name)}.items() <= found.items():
                return self._valid()
        return [f"{self.target}: neither the new archive nor the old: {difference(found, self.reference)}"]

    def whole(self) -> bool:
        """Return whether it is the new archive."""
        return content(self.target).get(INDEX_NAME) == self.reference[INDEX_NAME]

    def finished(self) -> list[str]:
        """Return the faults after the scan was added, even by a command stopped during its cleanup."""
        return self.visible() if self.whole() else [f"{self.target}: the scan is not in it"]


def _is_derived(name: str) -> bool:
    """Return whether a file of an archive, by its path there, is of the preview or the level."""
    return name == PREVIEW_NAME or name.startswith(f"{LEVEL_FOLDER}/")


def arguments(scans: Path, target: Path, jobs: int) -> list[str]:
    """Return the arguments of the command that builds the scans."""
    return [
        "build",
        str(scans),
        "-o",
        str(target),
        "--voxel",
        str(VOXEL),
        "--jobs",
        str(jobs),
        "--keep",
        "scan",
    ]


def difference(found: dict[str, str], expected: dict[str, str]) -> str:
    """Describe briefly which files differ."""
    missing = sorted(expected.keys() - found.keys())
    extra = sorted(found.keys() - expected.keys())
    other = sorted(name for name in found.keys() & expected.keys() if found[name] != expected[name])
    said = [
        f"{what} {', '.join(names[:3])}"
        for what, names in (("missing", missing), ("extra", extra), ("other", other))
        if names
    ]
    return "; ".join(said) or "the same"


class Tally:
    """Counts of the disturbed builds and their faults; `bad` holds each fault with how to reproduce it."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.stages: Counter[str] = Counter()
        self.bad: list[dict[str, Any]] = []

    def add(self, what: str, faults: list[str], **how: Any) -> None:
        """Count one more of `what`, with its faults."""
        self.counts[what] += 1
        if faults:
            self.bad.append({"what": what, **how, "faults": faults})

    def summary(self) -> dict[str, Any]:
        """Return all counts, for JSON."""
        return {"counts": dict(self.counts), "stages": dict(self.stages), "bad": self.bad}
