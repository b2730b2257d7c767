"""Scans added to an archive and removed from it: what a build of all of them would have held, whenever it is killed."""

import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import cases
import numpy as np
import pytest
import scans
from numpy.typing import NDArray
from solidcloud.builder import change as change_module
from solidcloud.builder import generation as generation_module
from solidcloud.builder.change import config_of, delete_orphans
from solidcloud.builder.config import BuildConfig
from solidcloud.builder.generation import ChangeSummary, add_scans, remove_scans, within_reach
from solidcloud.builder.pipeline import build_archive
from solidcloud.builder.preview import write_preview
from solidcloud.builder.radius import voxel_points
from solidcloud.builder.verify import verify_archive
from solidcloud.builder.workplace import locked
from solidcloud.schemas.archive import Archive
from solidcloud.schemas.errors import BadRequestError, CorruptError, FormatError, ScanError, SolidcloudError
from solidcloud.schemas.index_file import INDEX_NAME
from solidcloud.schemas.shard import SHARD_FOLDER
from solidcloud.schemas.vtkhdf import PREVIEW_NAME
from solidcloud.server.scene import Scene

OPTIONS: dict[str, Any] = {"voxel": 0.5, "resolution": 1e-3, "jobs": 1}
EVERYTHING = frozenset({"scan", "intensity"})


def cloud(kind: str, seed: int, count: int) -> NDArray[np.float64]:
    """Points on the lattice, so that no build moves them, off its border."""
    return np.round(0.25 + 0.75 * scans.make_scan(kind, seed, count), 3)


# The corner makes the origin of every lattice the same. B lies in some voxels of A, and in new ones.
A = np.vstack([[[0.0, 0, 0]], cloud("corner", 1, 900)])
B = np.vstack([cloud("noise", 2, 150) * [0.5, 0.5, 0.5], [[2.6, 2.6, 2.6], [-0.0, 0.0, 0.0]]]).round(3)
C = cloud("pillar", 3, 300) + np.array([0.75, 0, 0])


class Files(NamedTuple):
    """The scans as files."""

    a: Path
    b: Path
    c: Path


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """A, B and C, with intensities."""
    folder = tmp_path_factory.mktemp("scans")
    rng = np.random.default_rng(9)
    return Files(
        *(
            scans.write_ply(folder / f"{name}.ply", xyz, rng.integers(0, 4, len(xyz)).astype(np.float32))
            for name, xyz in (("a", A), ("b", B), ("c", C))
        )
    )


Build = Callable[..., Path]


@pytest.fixture(scope="module")
def built(files: Files, tmp_path_factory: pytest.TempPathFactory) -> Build:
    """Builds archives of some scans, each once, and copies them."""
    kept: dict[Any, Path] = {}

    def build(target: Path, which: str, **options: Any) -> Path:
        known = (which, *sorted(options.items()))
        if known not in kept:
            kept[known] = tmp_path_factory.mktemp("built") / "archive"
            chosen = [getattr(files, name) for name in which]
            build_archive(chosen, kept[known], BuildConfig(**{**OPTIONS, **options}))
        shutil.copytree(kept[known], target)
        return target

    return build


def content(folder: Path) -> dict[int, dict[str, bytes]]:
    """The bytes of every record's columns by key, scan_index as the paths of the scans."""
    found = {}
    with Archive(folder) as archive:
        names = [Path(source.path).name for source in archive.header.sources]
        for row in range(len(archive.voxels)):
            voxel, _ = archive.read_voxel(row)
            columns = {
                f"{part}.{name}": column.tobytes()
                for part in ("cells", "nodes")
                for name, column in getattr(voxel, part)._asdict().items()
            }
            columns |= {
                name: getattr(voxel, name).tobytes()
                for name in ("points", "intensity", "radius_class")
                if getattr(voxel, name) is not None
            }
            if voxel.scan_index is not None:
                columns["scan"] = ",".join(names[scan] for scan in voxel.scan_index.tolist()).encode()
            found[int(archive.voxels["key"][row])] = columns
    return found


def all_points(folder: Path) -> NDArray[np.float64]:
    """Every point of an archive, sorted."""
    with Archive(folder) as archive:
        lattice = archive.header.lattice
        parts = [
            voxel_points(*archive.read_voxel(row)) + archive.coordinates[row] * lattice.voxel_steps
            for row in range(len(archive.voxels))
        ]
        xyz = lattice.to_world(np.concatenate(parts)).round(3) + 0.0
    return xyz[np.lexsort(xyz.T)]


def sort_points(*clouds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Points of several scans in the order of `all_points`."""
    xyz = np.concatenate(clouds).round(3) + 0.0
    return xyz[np.lexsort(xyz.T)]


def snapshot(folder: Path) -> dict[str, bytes]:
    """Every file below a folder and what is in it."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def same_scene(one: Path, other: Path) -> None:
    """Assert that two archives hold the same: points, trees, counts, bounds, distances."""
    assert content(one) == content(other)
    with Archive(one) as first, Archive(other) as second:
        a, b = first.header, second.header
        assert (a.points, a.low.tolist(), a.high.tolist(), a.lattice) == (
            b.points, b.low.tolist(), b.high.tolist(), b.lattice,
        )  # fmt: skip
        assert a.radius_counts.tolist() == b.radius_counts.tolist() and a.radius_capped == b.radius_capped
        held = [sorted((Path(s.path).name, s.count) for s in h.sources if not s.fault) for h in (a, b)]
        assert held[0] == held[1]
    assert not verify_archive(one, deep=True).faults


MODELS = [
    frozenset({"mean"}),
    frozenset({"mean", "local"}),
    frozenset({"mean", "border"}),
    frozenset({"mean", "local", "border"}),
]


@pytest.mark.parametrize("models", MODELS, ids=lambda m: ",".join(sorted(m)))
@pytest.mark.parametrize("keep", [EVERYTHING, frozenset()], ids=["everything", "nothing"])
def test_what_is_added_is_as_if_built_together(
    built: Build, files: Files, tmp_path: Path, models: frozenset[str], keep: frozenset[str]
) -> None:
    options = {"models": models, "keep": keep}
    target = built(tmp_path / "x", "a", **options)
    summary = add_scans(target, [files.b], jobs=1)
    assert (summary.generation, summary.points_before, summary.points) == (1, len(A), len(A) + len(B))
    same_scene(target, built(tmp_path / "ab", "ab", **options))
    assert np.array_equal(all_points(target), sort_points(A, B))
    summary = add_scans(target, [files.c], jobs=1)
    assert summary.generation == 2
    same_scene(target, built(tmp_path / "abc", "abc", **options))
    assert not verify_archive(target).notes, "the preview is of this generation"


@pytest.mark.parametrize("models", MODELS, ids=lambda m: ",".join(sorted(m)))
def test_what_is_left_is_as_if_built_without(
    built: Build, files: Files, tmp_path: Path, models: frozenset[str]
) -> None:
    options = {"models": models, "keep": EVERYTHING}
    target = built(tmp_path / "x", "abc", **options)
    summary = remove_scans(target, [str(files.b)], jobs=1)
    assert (summary.generation, summary.points, summary.scans) == (1, len(A) + len(C), (f"{files.b}[0]",))
    assert summary.gone > 0, "voxels of B alone are not there any more"
    same_scene(target, built(tmp_path / "ac", "ac", **options))
    assert np.array_equal(all_points(target), sort_points(A, C))


def test_neighbours_count_across_several_voxels(built: Build, files: Files, tmp_path: Path) -> None:
    """Where a voxel is smaller than the reach of a neighbour, voxels change in which nothing was added."""
    options = {"models": frozenset({"mean", "local", "border"}), "keep": frozenset({"scan"}), "voxel": 0.3}
    target = built(tmp_path / "x", "a", **options)
    with Archive(built(tmp_path / "ab", "ab", **options)) as both, Archive(target) as archive:
        voxels, steps = len(both.voxels), both.header.lattice.voxel_steps
        assert 0 < archive.header.radius_capped != both.header.radius_capped
    summary = add_scans(target, [files.b], jobs=1)
    of_b = {tuple(voxel) for voxel in (np.rint(B / 1e-3).astype(int) // steps).tolist()}
    assert len(of_b) < summary.built < voxels, "some were, some were not"
    same_scene(target, tmp_path / "ab")
    remove_scans(target, [str(files.a)], jobs=1)
    with Archive(target) as archive:
        assert archive.header.points == len(B)
    assert not verify_archive(target, deep=True).faults


def test_added_and_removed_again_is_as_before(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a", keep=EVERYTHING)
    before = content(target)
    add_scans(target, [files.b, files.c], jobs=1)
    assert content(target) != before
    remove_scans(target, [str(files.b), f"{files.c}[0]"], jobs=1)
    assert content(target) == before
    add_scans(target, [files.b], jobs=1)  # removed, and so not in
    same_scene(target, built(tmp_path / "ab", "ab", keep=EVERYTHING))


def test_what_is_not_touched_keeps_its_bytes(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a")
    with Archive(target) as archive:
        old = {int(r["key"]): (archive.shards()[r["shard"]][0], r.tobytes()) for r in archive.voxels}
        radius, archive_id = archive.header.radius, archive.header.archive_id
    with (tmp_path / "far.ply").open("w"):
        scans.write_ply(tmp_path / "far.ply", np.array([[0.3, 0.3, 0.3], [3.1, 3.1, 3.1]]))
    summary = add_scans(target, [tmp_path / "far.ply"], jobs=1)
    assert summary.built == 2 and summary.dead_bytes > 0
    with Archive(target) as archive:
        names = [name for name, _ in archive.shards()]
        assert names == ["0-000000.h5", "1-000000.h5"]
        moved = 0
        for row in archive.voxels:
            if names[row["shard"]].startswith("0-"):
                assert old[int(row["key"])] == ("0-000000.h5", row.tobytes())
            else:
                moved += 1
        assert moved == 2
        header = archive.header
        assert (header.radius, header.archive_id) == (radius, archive_id), "as they were built"
        assert header.generation == 1 and header.format_version == 3


def test_the_figure_of_now_stands_beside_the_one_that_is_stored(
    built: Build, files: Files, tmp_path: Path
) -> None:
    target = built(tmp_path / "x", "a")
    with Archive(target) as archive:
        stored = archive.header.radius
    summary = add_scans(target, [files.b], jobs=1)
    with Archive(built(tmp_path / "ab", "ab")) as archive:
        expected = archive.header
    with Archive(target) as archive:
        now = archive.header.radius_now
    assert now is not None and summary.radius_now == now
    assert (now.radius, now.error, now.sample) == (
        expected.radius, expected.radius_error, expected.radius_sample,
    )  # fmt: skip
    assert summary.radius == stored != now.radius
    with Scene.open(target) as scene:
        info = scene.info()
        assert (info.generation, info.radius, info.radius_now) == (1, stored, now.radius)


def test_a_given_figure_has_none_beside_it(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a", radius=0.01)
    assert add_scans(target, [files.b], jobs=1).radius_now is None
    with Archive(target) as archive:
        assert archive.header.radius_now is None and archive.header.radius == 0.01


def test_what_touches_is_by_brute_force_the_same(built: Build, files: Files, tmp_path: Path) -> None:
    rng = np.random.default_rng(4)
    body = np.array([[0.0, 0, 0], [0.1, 0, 0.05]])
    target = built(tmp_path / "x", "a", keep=EVERYTHING, radius=0.01)
    for change, points in (
        (lambda: add_scans(target, [files.b, files.c], jobs=1), np.vstack([A, B, C])),
        (lambda: remove_scans(target, [str(files.a)], jobs=1), np.vstack([B, C])),
    ):
        change()
        case = cases.Case(target, points)
        poses = cases.near_poses(rng, points, body, 200, 0.1)
        expected = case.judge(body, 0.02, poses)
        assert 20 < expected.sum() < 180
        assert cases.ask(case, body, 0.02, poses).astype(bool).tolist() == expected.tolist()


def test_contacts_name_the_scan_they_are_of(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "ab", keep=EVERYTHING, radius=0.01)
    remove_scans(target, [str(files.b)], jobs=1)
    add_scans(target, [files.c], jobs=1)
    with Scene.open(target) as scene:
        info = scene.info()
        scene.add_avatar("al", np.zeros((1, 3)), 0.001)
        for name, point in (("a.ply", A[5]), ("c.ply", C[5])):
            found = scene.contacts("al", cases.pose_of(np.eye(3), point)[None])
            named = {Path(info.sources[scan].path).name for scan in found.scan_index.tolist()}
            assert name in named and "b.ply" not in named
        gone = next(source for source in info.sources if source.path == str(files.b))
        assert (gone.count, "removed in generation 1" in gone.fault) == (0, True)


def test_jobs_and_memory_change_nothing(built: Build, files: Files, tmp_path: Path) -> None:
    options = {"models": frozenset({"mean", "local"}), "keep": EVERYTHING}
    one, two = (built(tmp_path / name, "a", **options) for name in "xy")
    add_scans(one, [files.b, files.c], jobs=1)
    add_scans(two, [files.b, files.c], jobs=2, memory_bytes=64 << 20)
    assert snapshot(one) == snapshot(two)


def test_several_runs_of_several_units_are_one(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one, two = (built(tmp_path / name, "a", keep=EVERYTHING) for name in "xy")
    add_scans(one, [files.b, files.c], jobs=1)
    monkeypatch.setattr(change_module, "UNIT_POINTS", 100)
    monkeypatch.setattr(generation_module, "RUN_BYTES_A_POINT", 1 << 40)
    add_scans(two, [files.b, files.c], jobs=1)
    assert snapshot(one) == snapshot(two)


# --- what is refused --------------------------------------------------------------------------------------


def refused(target: Path, error: type[Exception], match: str, change: Callable[[], ChangeSummary]) -> None:
    """Assert that a change is refused, and that nothing is left of it."""
    before = snapshot(target.parent)
    with pytest.raises(error, match=match):
        change()
    assert snapshot(target.parent) == before


def test_a_scan_that_is_in_is_refused_unless_again(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "ab", keep=EVERYTHING)
    copy = shutil.copy(files.b, tmp_path / "copy.ply")
    for path in (files.b, Path(copy)):
        refused(
            target,
            BadRequestError,
            r"is in already, as .*b\.ply\[0\]",
            lambda p=path: add_scans(target, [p], jobs=1),
        )
    other = Path(shutil.copy(files.c, tmp_path / "other.ply"))
    refused(target, BadRequestError, "is in already", lambda: add_scans(target, [files.c, other], jobs=1))
    refused(target, BadRequestError, "named twice", lambda: add_scans(target, [files.c, files.c], jobs=1))
    add_scans(target, [files.b], again=True, jobs=1)
    assert np.array_equal(all_points(target), sort_points(A, B, B))
    remove_scans(target, ["2"], jobs=1)
    same_scene(target, built(tmp_path / "ab", "ab", keep=EVERYTHING))


def test_scans_that_are_in_are_named_or_left_out_before_points_are_read(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = built(tmp_path / "x", "ab", keep=EVERYTHING)
    surveyed: list[str] = []
    survey = generation_module.survey_range

    def noted(unit: Any) -> Any:
        surveyed.append(unit.scan.path.name)
        return survey(unit)

    monkeypatch.setattr(generation_module, "survey_range", noted)
    everything = files.a.parent
    named = r"2 of 3 scans: .*--new.*\n  .*a\.ply\[0\] is in already, as .*a\.ply\[0\]\n  .*b\.ply\[0\] is in already"
    refused(target, BadRequestError, named, lambda: add_scans(target, [everything], jobs=1))
    assert not surveyed
    added = add_scans(target, [everything], new_only=True, jobs=1)
    assert [Path(name).name for name in added.scans] == ["c.ply[0]"] and set(surveyed) == {"c.ply"}
    same_scene(target, built(tmp_path / "abc", "abc", keep=EVERYTHING))
    refused(
        target,
        BadRequestError,
        "nothing is new",
        lambda: add_scans(target, [everything], new_only=True, jobs=1),
    )


def test_scans_that_cannot_be_used_are_refused(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a")
    bad = tmp_path / "bad.ply"
    bad.write_bytes(files.b.read_bytes()[:-7])
    refused(target, ScanError, r"bad\.ply", lambda: add_scans(target, [files.c, bad], jobs=1))
    refused(target, ScanError, r"none\.ply", lambda: add_scans(target, [tmp_path / "none.ply"], jobs=1))


def test_a_scan_that_was_left_out_and_is_added_is_unknown_no_more(files: Files, tmp_path: Path) -> None:
    """Where it may have been is known again; the others' regions stay theirs."""
    rng = np.random.default_rng(4)
    whole = {name: tmp_path / f"{name}.las" for name in "mno"}
    for place, path in enumerate(whole.values()):
        scans.write_las(path, rng.integers(0, 1000, (90, 3)) + 2000 * place)
    bytes_of = {name: path.read_bytes() for name, path in whole.items()}
    (lost := tmp_path / "p.ply").write_bytes(b"no scan")
    for path in whole.values():
        path.write_bytes(path.read_bytes()[:-40])
    target = tmp_path / "x"
    build_archive([files.a, *whole.values(), lost], target, BuildConfig(**OPTIONS, skip_bad=True))

    def unknown() -> tuple[dict[str, list[Any]], bool]:
        with Archive(target) as archive:
            header = archive.header
        held = {Path(s.path).name: s.unknown for s in header.sources if s.unknown is not None}
        assert sorted(row for row in held.values() if row >= 0) == list(range(len(header.unknown)))
        boxes = {name: header.unknown[row].tolist() if row >= 0 else [] for name, row in held.items()}
        return boxes, header.unknown_everywhere

    before, everywhere = unknown()
    assert everywhere and set(before) == {"m.las", "n.las", "o.las", "p.ply"}
    assert all(low[0] < high[0] for low, high in (before[f"{name}.las"] for name in "mno"))
    whole["n"].write_bytes(bytes_of["n"])
    add_scans(target, [whole["n"]], jobs=1)
    assert unknown() == ({name: box for name, box in before.items() if name != "n.las"}, True)
    shutil.copy(files.b, lost)
    add_scans(target, [lost, files.c], jobs=1)
    assert unknown() == ({name: before[name] for name in ("m.las", "o.las")}, False)
    for name in "mo":
        whole[name].write_bytes(bytes_of[name])
    add_scans(target, [whole["m"], whole["o"]], jobs=1)
    assert unknown() == ({}, False) and not verify_archive(target).faults


@pytest.mark.parametrize("stage", ["_spool_added", "verify_new"])
def test_a_scan_that_is_written_anew_meanwhile_is_refused(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, stage: str
) -> None:
    """Other points would be in under the hash of those that it had, as many as they are."""
    target = built(tmp_path / "there" / "x", "a")
    path = Path(shutil.copy(files.b, tmp_path / "other.ply"))
    work = getattr(generation_module, stage)

    def written_before(change: Any, given: Any) -> Any:
        scans.write_ply(path, B[::-1].copy(), np.zeros(len(B), np.float32))
        return work(change, given)

    with monkeypatch.context() as patch:
        patch.setattr(generation_module, stage, written_before)
        refused(
            target,
            ScanError,
            r"other\.ply .*: changed while it was read.*: add it again",
            lambda: add_scans(target, [path], jobs=1),
        )
    assert add_scans(target, [path], jobs=1).generation == 1


def test_a_scan_too_far_away_is_refused(built: Build, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a")
    far = scans.write_ply(tmp_path / "far.ply", np.array([[9e8, 0.0, 0]]))
    refused(target, BadRequestError, "expected within", lambda: add_scans(target, [far], jobs=1))


def test_removing_needs_scans_and_leaves_one(built: Build, files: Files, tmp_path: Path) -> None:
    plain = built(tmp_path / "p" / "x", "ab") if (tmp_path / "p").mkdir() is None else tmp_path
    refused(plain, BadRequestError, "built without --keep scan", lambda: remove_scans(plain, ["0"], jobs=1))
    target = built(tmp_path / "x", "ab", keep=EVERYTHING)
    for named in ("nothing.ply", "2", "-1", str(files.c)):
        refused(
            target,
            BadRequestError,
            "is no scan of this archive; there are 0: ",
            lambda n=named: remove_scans(target, [n], jobs=1),
        )
    refused(
        target, BadRequestError, "nothing would be left", lambda: remove_scans(target, ["0", "1"], jobs=1)
    )
    refused(target, BadRequestError, "no scan is named", lambda: remove_scans(target, [], jobs=1))
    remove_scans(target, ["0"], jobs=1)
    refused(target, BadRequestError, "is no scan", lambda: remove_scans(target, ["0"], jobs=1))
    refused(target, BadRequestError, "nothing would be left", lambda: remove_scans(target, ["1"], jobs=1))


def test_what_is_no_archive_is_refused(files: Files, tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    for change in (lambda: add_scans(tmp_path / "x", [files.b]), lambda: remove_scans(tmp_path / "x", ["0"])):
        with pytest.raises(FormatError, match="no archive here"):
            change()


def test_a_second_one_is_refused_while_one_is_at_work(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a")
    with locked(target), pytest.raises(BadRequestError, match="another build is writing it"):
        add_scans(target, [files.b], jobs=1)


def test_options_that_look_at_all_scans_are_refused(built: Build, tmp_path: Path) -> None:
    with Archive(built(tmp_path / "x", "a")) as archive:
        header = archive.header
    config = config_of(header, tmp_path, 1, 64 << 20)
    assert config.identity() == header.options and (config.jobs, config.memory_bytes) == (1, 64 << 20)
    header.options["outliers"] = [0.1, 3]
    with pytest.raises(BadRequestError, match="built with outliers"):
        config_of(header, tmp_path, 1, 64 << 20)


def test_a_damaged_record_stops_it(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "a", keep=EVERYTHING)
    with Archive(target) as archive:
        at = [(int(r["frame_offset"][2]), int(r["frame_bytes"][2])) for r in archive.voxels]
    with open(target / SHARD_FOLDER / "0-000000.h5", "r+b") as file:
        for offset, size in at:
            file.seek(offset + size // 2)
            byte = file.read(1)[0]
            file.seek(offset + size // 2)
            file.write(bytes([byte ^ 1]))
    refused(target, CorruptError, "voxel", lambda: add_scans(target, [files.b], jobs=1))


# --- killed ------------------------------------------------------------------------------------------------

# What changes files, all of which a change goes through by name.
STEPS = ("replace", "rename", "unlink", "fsync", "link", "symlink", "mkdir", "rmdir")


def run_killed(change: Callable[[], object], step: int | None) -> list[str]:
    """Run a change in a process of its own that ends without a word before file operation number `step`.

    Returns the names of all of them where it is not killed, for None.
    """
    reading, writing = os.pipe()
    child = os.fork()
    if child == 0:
        done: list[str] = []
        kept = {name: getattr(os, name) for name in STEPS}

        def counted(name: str) -> Callable[..., Any]:
            def call(*what: Any, **more: Any) -> Any:
                if len(done) == step:
                    os._exit(9)
                done.append(name)
                return kept[name](*what, **more)

            return call

        try:
            for name in STEPS:
                setattr(os, name, counted(name))
            change()
            os.write(writing, " ".join(done).encode())
        finally:
            os._exit(0)
    os.close(writing)
    with open(reading, "rb") as pipe:
        told = pipe.read()
    _, status = os.waitpid(child, 0)
    assert os.waitstatus_to_exitcode(status) == (0 if step is None else 9)
    return told.decode().split()


def changes(files: Files) -> dict[str, Callable[[Path], object]]:
    """What is killed."""
    return {
        "add": lambda target: add_scans(target, [files.b], jobs=1),
        "remove": lambda target: remove_scans(target, [str(files.a)], jobs=1),
    }


@pytest.mark.parametrize("what", ["add", "remove"])
def test_killed_anywhere_it_is_the_old_archive_or_the_new_one(
    built: Build, files: Files, tmp_path: Path, what: str
) -> None:
    change = changes(files)[what]
    begin = built(tmp_path / "begin", "ac", keep=EVERYTHING)
    # Once before: what is compiled on first use is written to numba's cache, and would be counted among the steps.
    shutil.copytree(begin, tmp_path / "warm" / "hall")
    change(tmp_path / "warm" / "hall")
    undisturbed = tmp_path / "there" / "hall"
    shutil.copytree(begin, undisturbed)
    steps = run_killed(lambda: change(undisturbed), None)
    old, new = snapshot(begin), snapshot(undisturbed)
    assert old != new
    # Each renaming and what comes next, and of the others some.
    renamed = {n for n, name in enumerate(steps) if name in ("rename", "replace")}
    assert len(renamed) > 5
    seen = set()
    for step in sorted(
        renamed | {n + 1 for n in renamed if n + 1 < len(steps)} | set(range(0, len(steps), 5))
    ):
        place = tmp_path / f"at{step}"
        target = place / "hall"
        shutil.copytree(begin, target)
        run_killed(lambda target=target: change(target), step)
        assert not verify_archive(target).faults
        found = snapshot(target)
        is_new = found[INDEX_NAME] == new[INDEX_NAME]
        seen.add(is_new)
        preview = found.pop(PREVIEW_NAME)
        assert preview == old[PREVIEW_NAME] or (is_new and preview == new[PREVIEW_NAME])
        whole = {name: held for name, held in (new if is_new else old).items() if name != PREVIEW_NAME}
        assert whole.items() <= found.items(), "what the index names is there, byte for byte"
        if not is_new:
            change(target)
            assert snapshot(target) == new, "what a killed run left is gone, and nothing else is different"
        else:
            with Archive(target) as archive:
                delete_orphans(target, {name for name, _ in archive.shards()})
            write_preview(target)
            assert snapshot(target) == new
        shutil.rmtree(place)
    assert seen == {False, True}


def test_a_failure_leaves_the_old_archive_and_nothing_else(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target = built(tmp_path / "x", "a")

    def broken(*_: object) -> Iterator[None]:
        raise OSError(28, "No space left on device")

    for name in ("gather", "build_shard", "archive_mean", "write_index", "verify_new"):
        with monkeypatch.context() as patch:
            patch.setattr(generation_module, name, broken)
            refused(
                target,
                SolidcloudError,
                "No space.*: the archive is what it was",
                lambda: add_scans(target, [files.b], jobs=1),
            )
    rename = os.replace

    def broken_index(source: Path, to: Path) -> None:
        if Path(to) == target / INDEX_NAME:
            broken()
        rename(source, to)

    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", broken_index)
        refused(
            target,
            SolidcloudError,
            "No space.*: the archive is what it was",
            lambda: add_scans(target, [files.b], jobs=1),
        )
    assert add_scans(target, [files.b], jobs=1).generation == 1


@pytest.mark.parametrize("error", [KeyboardInterrupt(), OSError(5, "Input/output error")])
def test_an_error_told_once_the_index_is_renamed_leaves_the_new_archive(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: BaseException
) -> None:
    """As an interruption during the call is told after it, and some file servers tell an error of what they did."""
    target = built(tmp_path / "x", "a")
    rename = os.replace

    def renamed_and_broken(source: Path, to: Path) -> None:
        rename(source, to)
        if Path(to) == target / INDEX_NAME:
            raise error

    told = "Input/output.*: the archive is changed all the same" if isinstance(error, OSError) else None
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", renamed_and_broken)
        expected = SolidcloudError if told else KeyboardInterrupt
        with pytest.raises(expected, match=told):
            add_scans(target, [files.b], jobs=1)
    report = verify_archive(target)
    assert not report.faults and report.points == len(A) + len(B)
    with Archive(target) as archive:
        assert archive.header.generation == 1
    assert add_scans(target, [files.c], jobs=1).generation == 2


@pytest.mark.parametrize("keep", [frozenset({"scan"}), frozenset()])
def test_a_disk_without_room_is_told_before_it_is_full(
    built: Build, files: Files, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, keep: frozenset[str]
) -> None:
    """First for the new points, then with those that are read again and built."""
    target = built(tmp_path / "there" / "x", "ac", keep=keep)
    row = 12 + 2 * ("scan" in keep)
    with Archive(target) as archive:
        held = archive.header.points
    free = 0

    def usage(_: Path) -> Any:
        return shutil._ntuple_diskusage(1 << 40, 0, free)

    def too_little(bytes_: int, change: Callable[[], ChangeSummary]) -> int:
        nonlocal free
        free = bytes_
        with pytest.raises(SolidcloudError, match=f"{free} bytes free, the change needs about") as told:
            refused(target, SolidcloudError, "make room; the archive is what it was", change)
            change()
        return int(str(told.value).split("about ")[1].split(":")[0])

    monkeypatch.setattr(shutil, "disk_usage", usage)
    needed = too_little(len(B) * row, lambda: add_scans(target, [files.b], jobs=1))
    assert len(B) * row < needed < len(B) * (row + 20)
    needed = too_little(needed, lambda: add_scans(target, [files.b], jobs=1))
    assert needed > 100 * row
    free = needed
    assert add_scans(target, [files.b], jobs=1).points == held + len(B)
    if keep:
        needed = too_little(0, lambda: remove_scans(target, [str(files.b)], jobs=1))
        free = needed
        assert remove_scans(target, [str(files.b)], jobs=1).points == held


def test_shards_that_no_voxel_refers_to_are_deleted(built: Build, files: Files, tmp_path: Path) -> None:
    target = built(tmp_path / "x", "ab", keep=EVERYTHING)
    keep = target / SHARD_FOLDER / "notes.txt"
    keep.write_text("not ours")
    for number in range(3):
        add_scans(target, [files.c], again=True, jobs=1)
        remove_scans(target, [str(files.c)], jobs=1)
        with Archive(target) as archive:
            named = {name for name, _ in archive.shards()}
        assert {p.name for p in keep.parent.iterdir()} == named | {"notes.txt"}
        assert archive.header.generation == 2 * number + 2


# --- which voxels are near --------------------------------------------------------------------------------


def test_within_reach_holds_boxes_against_those_around_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each against all others would be quadratic in voxels: hours of a large archive."""
    corner = np.stack(np.meshgrid(*[np.arange(100)] * 2, [0], indexing="ij"), axis=-1).reshape(-1, 3) * 8000
    held = np.stack([corner, corner + 7999], axis=1)
    asked, maximum = [], np.maximum

    def counted(a: Any, b: Any) -> Any:
        asked.append(np.size(a))
        return maximum(a, b)

    monkeypatch.setattr(np, "maximum", counted)
    found = within_reach(held, held[::7], 100**2)
    assert sum(asked) < 9 * 3 * 2 * len(held)
    near = np.zeros((102, 102), bool)
    for x, y in corner[::7, :2] // 8000:
        near[x : x + 3, y : y + 3] = True
    assert np.array_equal(found, near[1:-1, 1:-1].ravel())


def test_within_reach_is_what_every_pair_says() -> None:
    rng = np.random.default_rng(1)
    low = rng.integers(-50, 50, (60, 3))
    held = np.stack([low, low + rng.integers(0, 20, (60, 3))], axis=1)
    low = rng.integers(-60, 60, (5, 3))
    boxes = np.stack([low, low + rng.integers(0, 20, (5, 3))], axis=1)
    for reach2, least in ((0, 0), (1, 0), (30, 1), (200, 2), (900, 5)):
        expected = [
            any(
                sum(max(0, int(a[0][k] - b[1][k]), int(b[0][k] - a[1][k])) ** 2 for k in range(3)) <= reach2
                for b in boxes
            )
            for a in held
        ]
        assert within_reach(held, boxes, reach2).tolist() == expected
        assert least <= sum(expected) < 50
    # Many blocks of many boxes each.
    low, at = rng.integers(-2500, 2500, (3000, 3)), rng.integers(-2500, 2500, (400, 3))
    held = np.stack([low, low + rng.integers(0, 300, (3000, 3))], axis=1)
    boxes = np.stack([at, at + rng.integers(0, 300, (400, 3))], axis=1)
    gaps = np.maximum(np.maximum(held[:, None, 0] - boxes[:, 1], boxes[:, 0] - held[:, None, 1]), 0)
    near = ((gaps**2).sum(axis=2) <= 100**2).any(axis=1)
    assert 500 < near.sum() < 2500
    assert np.array_equal(within_reach(held, boxes, 100**2), near)
    # Far apart, where squares of gaps would not fit 64 bits.
    far = np.array([[[1 << 40] * 3, [1 << 40] * 3]])
    assert within_reach(far, -far, 900).tolist() == [False]
