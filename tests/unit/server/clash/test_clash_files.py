"""Test the files of clashes: what they hold agrees with the list, and BCF with its schemas."""

import csv
import io
import json
import re
import zipfile
from datetime import datetime, timedelta, timezone
from xml.etree import ElementTree

import numpy as np
import pytest
from clash_answers import answers_of, invented
from PIL import Image
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.clash.bcf_file import Topic, bcf_bytes
from solidcloud.server.clash.clash_check import CheckedPath, Track
from solidcloud.server.clash.clash_list import list_clashes
from solidcloud.server.clash.clash_snapshot import Cloud, draw, png_bytes
from solidcloud.server.clash.clash_tables import COLUMNS, clashes_csv, clashes_json
from solidcloud.server.clash.clash_viewpoint import Viewpoint
from solidcloud.server.clash.path_motions import unknown_motions

NOW = datetime(2026, 3, 1, 12, 30, 15, 999, timezone(timedelta(hours=1)))
GUID = re.compile(r"[a-f0-9]{8}(-[a-f0-9]{4}){3}-[a-f0-9]{12}")
# Children of the elements that are written, in the order of the schemas of BCF 2.1 (markup.xsd,
# visinfo.xsd); a star marks those that must be there.
ORDER = {
    "Markup": "Header Topic* Comment Viewpoints",
    "Topic": (
        "ReferenceLink Title* Priority Index Labels CreationDate* CreationAuthor* ModifiedDate ModifiedAuthor DueDate "
        "AssignedTo Stage Description BimSnippet DocumentReference RelatedTopic"
    ),
    "Viewpoints": "Viewpoint Snapshot Index",
    "VisualizationInfo": "Components OrthogonalCamera PerspectiveCamera Lines ClippingPlanes Bitmap",
    "PerspectiveCamera": "CameraViewPoint* CameraDirection* CameraUpVector* FieldOfView*",
    "CameraViewPoint": "X* Y* Z*",
    "CameraDirection": "X* Y* Z*",
    "CameraUpVector": "X* Y* Z*",
    "Version": "DetailedVersion",
}
VIEW = Viewpoint(np.array([4.0, -3.0, 2.0]), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, 1.0]))


@pytest.fixture
def checked() -> CheckedPath:
    """A path of 30 poses with clashes, and one pose that is unknown."""
    rng = np.random.default_rng(8)
    path = [invented(rng) if k % 10 in (3, 4, 5) else None for k in range(30)]
    verdict = np.array([Verdict.CONTACT if pose else Verdict.CLEAR for pose in path], np.uint8)
    verdict[0] = Verdict.UNKNOWN
    distance = np.array([-pose[0].depth if pose else 0.5 for pose in path])
    clashes = list_clashes(np.arange(30), answers_of(path))
    assert len(clashes) == 3
    poses = np.tile(np.eye(4), (30, 1, 1))
    times, motions = np.arange(30) / 7, unknown_motions(29)
    motions.verdict[:] = np.maximum(verdict[:-1] == Verdict.CONTACT, verdict[1:] == Verdict.CONTACT)
    track = Track(np.arange(30.0), times, poses)
    return CheckedPath(times, poses, 1.0, distance, verdict, motions, track, clashes, True, -0.2)


def test_csv_has_a_row_for_each_clash_in_full_precision(checked: CheckedPath) -> None:
    header, *rows = csv.reader(io.StringIO(clashes_csv(checked)))
    assert tuple(header) == COLUMNS
    assert len(rows) == 3
    for number, (row, clash) in enumerate(zip(rows, checked.clashes, strict=True), 1):
        assert row[-1] == ""
        values = dict(zip(header[:-1], map(float, row[:-1]), strict=True))
        assert values["clash"] == number
        assert values["depth_m"] == clash.depth
        assert [values[axis] for axis in "xyz"] == clash.place.tolist()
        assert [values[f"normal_{axis}"] for axis in "xyz"] == clash.normal.tolist()
        assert (values["contacts"], values["clusters"]) == (clash.contacts, len(clash.clusters))
        ends = {"from": clash.first, "to": clash.last, "deepest": clash.deepest}
        for name, pose in ends.items():
            assert (values[f"pose_{name}"], values[f"t_{name}"]) == (pose, checked.times[pose])


def test_json_agrees_with_the_list(checked: CheckedPath) -> None:
    found = json.loads(clashes_json(checked, scene="hall", path="tour.csv"))
    assert (found["about"]["scene"], found["about"]["path"]) == ("hall", "tour.csv")
    assert found["verdicts"] == {"clear": 20, "contact": 9, "unknown": 1}
    assert found["least_clearance"] == checked.clearance
    assert found["unknown"] == [{"poses": [0, 0]}]
    for number, (values, clash) in enumerate(zip(found["clashes"], checked.clashes, strict=True), 1):
        assert (values["clash"], values["depth"], values["contacts"]) == (number, clash.depth, clash.contacts)
        assert values["place"] == clash.place.tolist()
        assert values["poses"] == [clash.first, clash.last]
        assert values["times"] == checked.times[[clash.first, clash.last]].tolist()
        assert [each["depth"] for each in values["clusters"]] == [each.depth for each in clash.clusters]
        assert [each["box"][0] for each in values["clusters"]] == [
            each.low.tolist() for each in clash.clusters
        ]


@pytest.fixture
def between(checked: CheckedPath) -> CheckedPath:
    """The same clashes, of which that at places 13 to 15 lies between pose 12 and pose 13."""
    number = np.concatenate([np.arange(13.0), [12.25, 12.5, 12.75], np.arange(13.0, 27.0)])
    return checked._replace(track=Track(number, number / 7, checked.track.poses))


def test_clash_between_poses_is_named_by_them_everywhere(between: CheckedPath) -> None:
    clash = next(each for each in between.clashes if each.first == 13)
    number = between.clashes.index(clash)
    deepest = 12 + (clash.deepest - 12) / 4
    row = list(csv.DictReader(io.StringIO(clashes_csv(between))))[number]
    assert (row["pose_from"], row["pose_to"], row["fraction"]) == ("12", "13", "0.25")
    assert float(row["pose_deepest"]) == deepest
    assert float(row["t_from"]) == 12.25 / 7
    values = json.loads(clashes_json(between))["clashes"][number]
    assert (values["poses"], values["fraction"], values["pose_deepest"]) == ([12, 13], 0.25, deepest)
    with zipfile.ZipFile(io.BytesIO(bcf_bytes(between, topics(between), "hall", "t.csv", NOW))) as archive:
        texts = [archive.read(name).decode() for name in archive.namelist() if name.endswith("markup.bcf")]
    assert "The motion between pose 12 and 13" in texts[number]
    assert f"at pose {deepest:g}" in texts[number]


def topics(checked: CheckedPath) -> list[Topic]:
    """Return the clashes with a picture each."""
    cloud = Cloud(checked.clashes[0].place[None], np.array([[255, 0, 0]], np.uint8), 0.1)
    picture = png_bytes(draw(VIEW, [cloud], (64, 36)))
    return [Topic(number, clash, VIEW, picture) for number, clash in enumerate(checked.clashes, 1)]


def check_order(element: ElementTree.Element) -> None:
    """Check that the children of an element, and theirs, are those of the schema, in its order."""
    children = [child.tag for child in element]
    if element.tag in ORDER:
        allowed = ORDER[element.tag].split()
        names = [name.rstrip("*") for name in allowed]
        assert sorted(children, key=names.index) == children
        assert {name.rstrip("*") for name in allowed if name.endswith("*")} <= set(children)
        assert len(set(children)) == len(children)
    else:
        assert children == [], element.tag
    for child in element:
        check_order(child)


def test_bcf_has_the_structure_of_its_schemas(checked: CheckedPath) -> None:
    content = bcf_bytes(checked, topics(checked), "hall <A&B>", "tour\x01\ud83d\ufffe.csv", NOW)
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        assert archive.testzip() is None
        files = {name: archive.read(name) for name in archive.namelist()}
    version = ElementTree.fromstring(files.pop("bcf.version"))
    assert (version.tag, version.attrib) == ("Version", {"VersionId": "2.1"})
    check_order(version)
    folders = sorted({name.split("/")[0] for name in files})
    assert len(folders) == 3
    assert set(files) == {
        f"{folder}/{name}" for folder in folders for name in ("markup.bcf", "viewpoint.bcfv", "snapshot.png")
    }
    guids = set(folders)
    for folder in folders:
        markup = ElementTree.fromstring(files[f"{folder}/markup.bcf"])
        view = ElementTree.fromstring(files[f"{folder}/viewpoint.bcfv"])
        assert (markup.tag, view.tag) == ("Markup", "VisualizationInfo")
        check_order(markup)
        check_order(view)
        topic, pictures = markup.find("Topic"), markup.find("Viewpoints")
        assert topic is not None
        assert pictures is not None
        assert topic.get("Guid") == folder
        assert pictures.get("Guid") == view.get("Guid")
        guids.add(str(view.get("Guid")))
        assert topic.findtext("CreationDate") == "2026-03-01T11:30:15Z"
        assert pictures.findtext("Viewpoint") == "viewpoint.bcfv"
        assert pictures.findtext("Snapshot") == "snapshot.png"
        clash = checked.clashes[int(topic.findtext("Index", "0")) - 1]
        assert f"{100 * clash.depth:.1f} cm" in topic.findtext("Title", "")
        description = topic.findtext("Description", "")
        assert f"Poses {clash.first} to {clash.last} " in description
        assert r"tour\x01\ud83d\ufffe.csv" in description
        assert "hall <A&B>" in description
        Image.open(io.BytesIO(files[f"{folder}/snapshot.png"])).verify()
    assert len(guids) == 6
    assert all(GUID.fullmatch(each) for each in guids)
