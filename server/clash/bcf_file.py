"""Clashes as a BCF 2.1 file (BIM Collaboration Format, buildingSMART): a topic for each.

The file is a zip archive: `bcf.version`, and for each topic a folder with `markup.bcf`, a viewpoint
and its picture. Other programs show the topics as a list, and put their camera where the viewpoint is.
"""

import io
import uuid
import zipfile
from collections.abc import Iterable
from datetime import UTC, datetime
from typing import NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ...schemas.runtime.visible_text import visible
from .clash_check import CheckedPath
from .clash_list import Clash
from .clash_viewpoint import FIELD_OF_VIEW, Viewpoint

VERSION = "2.1"
_AUTHOR = "solidcloud"
_NAMESPACE = uuid.UUID("6f0c6a3e-5b55-4d0c-9a51-6f3b1f3f6f2b")


class Topic(NamedTuple):
    """One clash of a file.

    number: in the list, from 1.  view: from where it is seen.  snapshot: PNG file from there.
    """

    number: int
    clash: Clash
    view: Viewpoint
    snapshot: bytes


def bcf_bytes(checked: CheckedPath, topics: Iterable[Topic], scene: str, path: str, now: datetime) -> bytes:
    """Return clashes as a BCF file. The same input gives the same bytes.

    scene, path: names that the descriptions mention; characters that XML lacks become escapes.
    now: date of the topics, with a time zone.
    """
    scene, path = visible(scene), visible(path)
    content = io.BytesIO()
    stamp = now.astimezone(UTC).replace(microsecond=0)
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:

        def add(name: str, data: bytes) -> None:
            archive.writestr(zipfile.ZipInfo(name, stamp.timetuple()[:6]), data, zipfile.ZIP_DEFLATED)

        add("bcf.version", _version())
        for topic in topics:
            identity = f"{scene}/{path}/{stamp.isoformat()}/{topic.number}"
            own, view = (str(uuid.uuid5(_NAMESPACE, f"{identity}/{part}")) for part in ("topic", "viewpoint"))
            date = stamp.strftime("%Y-%m-%dT%H:%M:%SZ")
            add(f"{own}/markup.bcf", _markup(checked, topic, own, view, date, scene, path))
            add(f"{own}/viewpoint.bcfv", _viewpoint(topic.view, view))
            add(f"{own}/snapshot.png", topic.snapshot)
    return content.getvalue()


def _version() -> bytes:
    """Return the file bcf.version."""
    root = ElementTree.Element("Version", {"VersionId": VERSION})
    _text(root, "DetailedVersion", VERSION)
    return _xml(root)


def _markup(
    checked: CheckedPath, topic: Topic, own: str, view: str, date: str, scene: str, path: str
) -> bytes:
    """Return the file markup.bcf of a topic. own, view: GUIDs of the topic and its viewpoint."""
    clash = topic.clash
    root = ElementTree.Element("Markup")
    markup = ElementTree.SubElement(root, "Topic", {"Guid": own, "TopicType": "Clash", "TopicStatus": "Open"})
    # The schema prescribes this order.
    place = ", ".join(f"{value:.3f}" for value in clash.place)
    _text(markup, "Title", f"Clash {topic.number}: {100 * clash.depth:.1f} cm deep at {place}")
    _text(markup, "Index", str(topic.number))
    _text(markup, "CreationDate", date)
    _text(markup, "CreationAuthor", _AUTHOR)
    first, last = checked.poses_of(clash.first, clash.last)
    fraction, number = checked.fraction(clash), checked.track.number[clash.deepest]
    times = f"{checked.track.times[clash.first]:.3f} to {checked.track.times[clash.last]:.3f} s"
    where = f"Poses {first} to {last} ({times}) of {path} are"
    if fraction is not None:
        where = f"The motion between pose {first} and {last} ({times}) of {path} is, from {fraction:.3f} of it on,"
    _text(
        markup,
        "Description",
        f"{where} in contact with the scan {scene}. "
        f"Greatest depth {clash.depth:.4f} m at pose {number:.10g}; "
        f"up to {clash.contacts} pairs of points in contact at a pose; "
        f"clusters of contacts: {len(clash.clusters)}.",
    )
    pictures = ElementTree.SubElement(root, "Viewpoints", {"Guid": view})
    _text(pictures, "Viewpoint", "viewpoint.bcfv")
    _text(pictures, "Snapshot", "snapshot.png")
    return _xml(root)


def _viewpoint(view: Viewpoint, guid: str) -> bytes:
    """Return the file viewpoint.bcfv."""
    root = ElementTree.Element("VisualizationInfo", {"Guid": guid})
    camera = ElementTree.SubElement(root, "PerspectiveCamera")
    ahead = view.direction
    right = np.cross(ahead, view.up)
    up = np.cross(right / np.linalg.norm(right), ahead)
    for name, values in (("CameraViewPoint", view.eye), ("CameraDirection", ahead), ("CameraUpVector", up)):
        _vector(camera, name, values)
    _text(camera, "FieldOfView", repr(FIELD_OF_VIEW))
    return _xml(root)


def _vector(parent: ElementTree.Element, name: str, values: NDArray[np.float64]) -> None:
    """Add a point or a direction."""
    element = ElementTree.SubElement(parent, name)
    for axis, value in zip("XYZ", values.tolist(), strict=True):
        _text(element, axis, repr(float(value)))


def _text(parent: ElementTree.Element, name: str, text: str) -> None:
    """Add an element with a text."""
    ElementTree.SubElement(parent, name).text = text


def _xml(root: ElementTree.Element) -> bytes:
    """Return an XML file."""
    ElementTree.indent(root)
    content: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return content
