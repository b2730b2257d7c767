"""E57 reader: pye57's binding of libE57Format, read in blocks of records.

pye57's own read_scan() reads a whole scan at once, of the size that the header claims. The
underlying reader fills buffers of any size repeatedly; this module uses it.
"""

import os
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from ....schemas.errors import ScanError
from ..common.colours import INTENSITY, RGB, whole_bytes
from ..common.scan import (
    BOUNDS_MARGIN,
    BrokenScan,
    Scan,
    ScanBlock,
    apply_pose,
    checked_bounds,
    damaged_error,
    library_errors,
    quaternion_pose,
    reader_library,
    scan_error,
    zero_rotation_note,
)
from ..common.units import axis_metres
from .e57_xml import (
    Section,
    check_e57,
    check_xml,
    checked_xml,
    plain_letters,
    record_sections,
    records_held,
    with_plain_letters,
    xml_of,
)

CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
INVALID_STATE = "invalid state"
SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
COLOURS = ("colorRed", "colorGreen", "colorBlue")
INVALID_COLOUR = "isColorInvalid"
# Greatest range of a channel that its type, without limits in the header, is believed to have.
MOST_COLOURS = 1 << 16

LONGEST_CRS = 1 << 16  # several times longer than any real text; a longer one is truncated


class _Fields(NamedTuple):
    """Names of the record fields to read."""

    coordinates: tuple[str, ...]
    invalid_state: str | None
    intensity: str | None
    # Red, green and blue with the least and greatest value of each, or (); and what marks a colour
    # as invalid.
    colours: tuple[tuple[str, float, float], ...]
    invalid_colour: str | None


class E57Scan(Scan):
    """One scan of an E57 file."""

    def __init__(
        self,
        path: Path,
        index: int,
        count: int,
        pose: NDArray[np.float64],
        bounds: NDArray[np.float64] | None,
        fields: _Fields,
        held: int,
    ) -> None:
        """Create the scan. held: records that its section holds at least."""
        super().__init__(path, "e57", index=index, declared_count=count, pose=pose, bounds=bounds)
        self._fields, self._held = fields, held
        self.columns = frozenset([INTENSITY] * bool(fields.intensity) + [RGB] * bool(fields.colours))

    def _read(self, block_points: int) -> Iterator[ScanBlock]:
        if self._held > (self.declared_count or 0):
            raise scan_error(
                self.path,
                f"scan {self.index} of at least {self._held} records",
                f"the {self.declared_count} its header declares",
                "fetch the file again, or check the program that wrote it",
            )
        if not self.declared_count:
            return
        libe57 = _libe57(self.path)
        with _image_file(self.path) as image:
            # The arrays must outlive the reader: it writes into them through raw pointers.
            arrays = {name: np.empty(block_points, np.float64) for name in self._fields.coordinates}
            if self._fields.intensity:
                arrays[self._fields.intensity] = np.empty(block_points, np.float32)
            if self._fields.invalid_state:
                arrays[self._fields.invalid_state] = np.empty(block_points, np.int8)
            if self.delivers(RGB):
                arrays |= {name: np.empty(block_points, np.float64) for name, _, _ in self._fields.colours}
                if self._fields.invalid_colour:
                    arrays[self._fields.invalid_colour] = np.empty(block_points, np.int8)
            buffers = libe57.VectorSourceDestBuffer()
            for name, array in arrays.items():
                # True, True: convert the stored type to the array's type, and scaled integers to
                # their values.
                buffers.append(libe57.SourceDestBuffer(image, name, array, block_points, True, True))
            reader = image.root()["data3D"][self.index]["points"].reader(buffers)
            seen = 0
            try:
                while got := reader.read():
                    seen += got
                    yield self._block({name: array[:got] for name, array in arrays.items()})
            finally:
                reader.close()
        if seen != self.declared_count:
            raise scan_error(
                self.path,
                f"scan {self.index} ends after {seen} records",
                f"the {self.declared_count} its header declares",
                "fetch the file again, it is damaged",
            )

    def _block(self, columns: dict[str, NDArray[Any]]) -> ScanBlock:
        """Build a block: drop and count invalid records, convert spherical coordinates, apply the pose."""
        fields = self._fields
        valid: Any = slice(None)
        if fields.invalid_state:
            # 0: valid; 1: a direction without a range; 2: nothing [ASTM E2807, 8.4.4]. Neither 1
            # nor 2 is a point.
            valid = columns[fields.invalid_state] == 0
            left_out = len(valid) - int(np.count_nonzero(valid))
            if left_out:
                self.dropped[INVALID_STATE] = self.dropped.get(INVALID_STATE, 0) + left_out
        xyz = np.stack([columns[name][valid] for name in fields.coordinates], axis=1)
        if fields.coordinates == SPHERICAL:
            xyz = _cartesian(xyz)
        # Copy the intensity: the reader fills the same array again.
        return ScanBlock(
            apply_pose(self.pose, xyz),
            columns[fields.intensity][valid].copy() if fields.intensity else None,
            self._colours(columns, valid) if self.delivers(RGB) else None,
        )

    def _colours(self, columns: dict[str, NDArray[Any]], valid: Any) -> NDArray[np.uint8]:
        """Return the colours (n, 3) of valid points, scaled from the limits in the header to 0 to 255."""
        fields = self._fields
        rgb = np.stack(
            [
                whole_bytes((columns[name][valid] - low) / (high - low) * 255)
                for name, low, high in fields.colours
            ],
            axis=1,
        )
        if fields.invalid_colour:
            rgb[columns[fields.invalid_colour][valid] != 0] = 0
        return rgb


def _cartesian(spherical: NDArray[np.float64]) -> NDArray[np.float64]:
    """Convert range [m], azimuth and elevation [rad] to x, y, z [m], (n, 3) both [ASTM E2807, 8.4.4]."""
    distance, azimuth, elevation = spherical.T
    with np.errstate(over="ignore", invalid="ignore"):  # non-finite angles give non-finite points
        level = distance * np.cos(elevation)
        x, y, z = level * np.cos(azimuth), level * np.sin(azimuth), distance * np.sin(elevation)
    return np.stack([x, y, z], axis=1)


def open_e57(path: Path) -> list[Scan]:
    """Return the scans of an E57 file, in file order; an empty list where it holds images only.

    Reads headers only. A scan with a broken header becomes a BrokenScan where another scan of the
    file is readable. Raises ScanError, also for a page whose checksum is wrong.
    """
    with library_errors(path):
        check_e57(path)
    with library_errors(path), _image_file(path) as image:
        if not image.root().isDefined("data3D"):
            return []
        data3d = image.root()["data3D"]
        scans: list[Scan] = []
        with path.open("rb") as file:
            sections = dict(enumerate(record_sections(xml_of(file))))
        for index in range(len(data3d)):
            try:
                scans.append(_open_scan(path, index, data3d[index], sections.get(index)))
            except ScanError as error:
                scans.append(BrokenScan(path, "e57", index, str(error)))
        if scans and all(scan.fault for scan in scans):
            raise ScanError(scans[0].fault)
        if image.root().isDefined("coordinateMetadata"):
            for scan in scans:
                scan.crs = str(image.root()["coordinateMetadata"].value())[:LONGEST_CRS]
        return scans


def _libe57(path: Path) -> Any:
    return reader_library("pye57", path).libe57


@contextmanager
def _image_file(path: Path) -> Iterator[Any]:
    """Open the file, or a copy with letters that libE57Format reads, and close it at the end."""
    open_file = _libe57(path).ImageFile
    with ExitStack() as held:
        try:
            image = open_file(os.fsencode(path), "r")
        except Exception:
            copy = held.enter_context(with_plain_letters(path))
            if copy is None:
                raise
            image = open_file(os.fsencode(copy), "r")
        held.callback(image.close)
        yield image


def _open_scan(path: Path, index: int, node: Any, section: Section | None) -> Scan:
    """Return one scan from its XML node. Raises ScanError."""
    if not node.isDefined("points"):
        raise scan_error(
            path,
            f"scan {index} without points",
            "a 'points' vector",
            "check the program that wrote this file",
        )
    points = node["points"]
    prototype = _libe57(path).StructureNode(points.prototype())
    names = {prototype.get(k).elementName() for k in range(prototype.childCount())}
    coordinates = next((kind for kind in (CARTESIAN, SPHERICAL) if names.issuperset(kind)), None)
    if coordinates is None:
        raise scan_error(
            path,
            f"scan {index} with the fields {', '.join(sorted(names))}",
            "cartesianX, Y, Z or sphericalRange, Azimuth, Elevation",
            "check the program that wrote this file",
        )
    invalid_state = "cartesianInvalidState" if coordinates == CARTESIAN else "sphericalInvalidState"
    fields = _Fields(
        coordinates,
        invalid_state if invalid_state in names else None,
        "intensity" if "intensity" in names else None,
        _colour_limits(node, prototype) if names.issuperset(COLOURS) else (),
        INVALID_COLOUR if INVALID_COLOUR in names else None,
    )
    numbers = {name: _number(node, *name.split("/")) for name in (*_POSE_NUMBERS, *_BOUNDS_NUMBERS)}
    pose = _pose(path, index, numbers)
    count = int(points.childCount())
    # A record of constants takes no bits, and a hostile file could claim any number of them. A real
    # scan has at least one bit per record.
    if count > 8 * path.stat().st_size:
        raise damaged_error(
            path,
            f"scan {index} of {count} records",
            f"at most the {8 * path.stat().st_size} bits of the file",
        )
    held = 0
    if section is not None:
        with path.open("rb") as file:
            held = records_held(file, section)
    # The bounds are those of the records that were counted, if the count is wrong.
    bounds = _bounds(numbers, pose) if held <= count else None
    scan = E57Scan(path, index, count, pose, bounds, fields, held)
    scan.notes = zero_rotation_note(path, index, [numbers[name] for name in _QUATERNION])
    return scan


def _colour_limits(node: Any, prototype: Any) -> tuple[tuple[str, float, float], ...]:
    """Return the channels of a scan's colours, each with its least and greatest value.

    These are the limits that the header states; else those of the channel's type; else 0 to 1 for
    floating-point numbers and 0 to 255 for others.
    """
    found = []
    for name in COLOURS:
        low, high = (_number(node, "colorLimits", name + end) for end in ("Minimum", "Maximum"))
        kind = prototype[name]
        if low is None or high is None or not low < high:
            if hasattr(kind, "scaledValue") or not hasattr(kind, "minimum"):
                low, high = 0.0, 255.0
            else:
                low, high = float(kind.minimum()), float(kind.maximum())
            if not (np.isfinite([low, high]).all() and low < high and high - low <= MOST_COLOURS):
                low, high = 0.0, 1.0 if hasattr(kind, "isDouble") or "Float" in type(kind).__name__ else 255.0
        found.append((name, low, high))
    return tuple(found)


_QUATERNION = tuple(f"pose/rotation/{name}" for name in "wxyz")
_TRANSLATION = tuple(f"pose/translation/{name}" for name in "xyz")
_POSE_NUMBERS = (*_QUATERNION, *_TRANSLATION)
_BOUNDS_NUMBERS = tuple(f"cartesianBounds/{axis}{end}" for end in ("Minimum", "Maximum") for axis in "xyz")


def _number(node: Any, *names: str) -> float | None:
    """Return the number at a path below a node, or None where there is none."""
    for name in names:
        if not hasattr(node, "isDefined") or not node.isDefined(name):
            return None
        node = node[name]
    return float(node.scaledValue() if hasattr(node, "scaledValue") else node.value())


def _pose(path: Path, index: int, numbers: dict[str, float | None]) -> NDArray[np.float64]:
    """Return the pose (4, 4) of a scan; the identity for parts it does not state. Raises ScanError."""
    return quaternion_pose(
        path, index, [numbers[name] for name in _QUATERNION], [numbers[name] for name in _TRANSLATION]
    )


def _bounds(numbers: dict[str, float | None], pose: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Return a world-frame box (2, 3) [m] that encloses the scan by its declared bounds, or None.

    The standard defines cartesianBounds in the scan's frame. pye57 instead writes two corners moved
    by the pose, which enclose nothing once the scan is rotated. The writer of the file is unknown.
    The box therefore covers both interpretations: the declared box as it is and the box moved by
    the pose. For a rotated scan each box is replaced by the cube around its bounding sphere,
    because a sphere is invariant under rotation.
    """
    corners = [numbers[name] for name in _BOUNDS_NUMBERS]
    if None in corners:
        return None
    box = checked_bounds(np.array(corners, np.float64).reshape(2, 3))
    if box is None or np.array_equal(pose, np.eye(4)):
        return box
    half = (box[1] - box[0]) / 2
    center = box[0] + half
    centers = np.stack([center, apply_pose(pose, center[None])[0]])
    if not np.array_equal(pose[:3, :3], np.eye(3)):
        half = np.full(3, np.linalg.norm(half))
    half += BOUNDS_MARGIN
    return checked_bounds(np.stack([centers.min(axis=0) - half, centers.max(axis=0) + half]))


def e57_bounds(path: Path, units: str = "") -> NDArray[np.float64] | None:
    """Return the bounds of all scans that an E57 file's XML declares, (2, 3) world frame [m].

    units: see `axis_metres`; "": metres, as the standard has it.
    Returns None where one scan has no bounds, because its points may then be anywhere. Reads the
    XML without libE57Format, which refuses the file. May raise anything, also where the XML itself
    may be damaged.
    """
    with path.open("rb") as file:
        xml = plain_letters(checked_xml(file))
    check_xml(xml)
    root = ElementTree.fromstring(xml)
    tag = root.tag.rpartition("}")[0] + "}" if "}" in root.tag else ""
    boxes: list[NDArray[np.float64]] = []
    metres = axis_metres(units or "m")
    for scan in root.iterfind(f"{tag}data3D/{tag}vectorChild"):
        numbers = {
            name: _xml_number(scan, [tag + part for part in name.split("/")])
            for name in (*_POSE_NUMBERS, *_BOUNDS_NUMBERS)
        }
        box = _bounds(numbers, _pose(path, len(boxes), numbers))
        if box is None:
            return None
        boxes.append(box)
    if not boxes or metres is None:
        return None
    return np.stack([np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]]) * metres


def _xml_number(element: ElementTree.Element, names: list[str]) -> float | None:
    """Return the number at a path below an element, or None.

    An element without text is 0 [ASTM E2807, 8.3].
    """
    found = element.find("/".join(names))
    if found is None:
        return None
    number = float(found.text or 0.0)
    if found.get("type") == "ScaledInteger":
        number = number * float(found.get("scale", 1.0)) + float(found.get("offset", 0.0))
    return number
