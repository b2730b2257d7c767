"""Points that cover the surface of a mesh, and those that fill closed meshes: the spheres leave no hole.

The surface: see `cover_surface`.

The inside: the points are a body-centred cubic lattice of covering radius `_COVER` times the radius r of a
sphere: no place is farther than that from the nearest node. Nodes inside the mesh become points. A
place p inside whose nearest node q is inside is therefore covered. If q is outside, the segment
from q to p crosses a triangle T. Let x be the place on T nearest to q. T is convex and lies behind
the plane through x at right angles to q - x, so p does too, and |p - x| <= |p - q| < r. Each such x
becomes a point. With t = |q - x| and h the largest height of another triangle's corners over that
plane, h <= t, a place p behind that triangle has |p - x|² <= |p - q|² - t² + 2 t h. Triangles for
which this is at most r² need no place of their own.

Which nodes are inside is decided on integers: corners are rounded to 2^-24 of the extent, columns
of nodes lie between them, and a column on an edge counts as left of it. No column passes through a
gap between two triangles.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.archive.units import MAX_COORDINATE
from ...schemas.errors import BadRequestError, TooLargeError
from ...schemas.wire.request_limits import MAX_AVATAR_POINTS

_Floats = NDArray[np.float64]
_Integers = NDArray[np.int64]

# Longest edge of a triangle whose corners cover it, in radii. No point of a triangle is farther from
# the nearest corner than the longest edge / sqrt(3), which an equilateral triangle attains. The rest
# up to sqrt(3) = 1.7321 covers the rounding of the corners.
_LONGEST_EDGE = 1.732
# Default radius of a mesh: the square root of its area, divided by this. The avatar then has some
# 10,000 to 30,000 points, whatever its size. It is 14 mm for a person.
_RADII = 100.0
# Step to which the default radius is rounded, as in `make_avatar` [m].
_STEP = 2.0**-20
# Largest default radius [m], that of an avatar in a scene file.
_MAX_RADIUS = 8.0
# Triangles held at most, 72 bytes each. A closed surface has half as many points as triangles.
_MAX_TRIANGLES = 3 * MAX_AVATAR_POINTS
# Covering radius of the lattice, in radii of a sphere. A smaller one takes more nodes; a larger one
# leaves less slack for the triangles near a node to share one point.
_COVER = 0.95
# Covering radius of the lattice over half of its period: sqrt(5) / 2.
_COVER_OF_HALF = math.sqrt(5) / 2
# Corners are rounded to the extent divided by this. Products of differences, doubled, fit 63 bits.
_STEPS = 1 << 24
# Pairs of a triangle and a column or node that are examined at a time.
_PAIRS = 1 << 20


class SurfaceCover(NamedTuple):
    """Cover of a surface.

    points: (n, 3) [m].  radius: used [m]; None if none was given and the surface has no area.
    triangles: (k, 3, 3), of the surface, after halving [m].
    """

    points: _Floats
    radius: float | None
    triangles: _Floats


def cover_surface(triangles: _Floats, radius: float | None, what: str) -> SurfaceCover:
    """Cover a surface with points: no part of it is farther than a radius from one.

    triangles: (m, 3, 3), the corners of each [m].  what: name of the mesh, for messages.
    radius: above 0 [m]; None: a hundredth of the square root of the area.
    Triangles with an edge longer than sqrt(3) radii are halved at their longest edge until none is
    left. The points are the corners of all triangles, each once, sorted: they depend neither on a
    random number nor on the order of vertices.
    Raise BadRequestError for a corner that is not finite or too far away, or a radius that is too
    small or too large, TooLargeError for more than MAX_AVATAR_POINTS points.
    """
    if not np.isfinite(triangles).all() or np.abs(triangles).max() > MAX_COORDINATE:
        raise BadRequestError(
            f"{what}: a vertex that is not finite or beyond {MAX_COORDINATE:g} m: expected finite coordinates [m]"
        )
    area = _area(triangles)
    if radius is None:
        if area == 0.0:
            return SurfaceCover(_distinct(triangles.reshape(-1, 3)), None, triangles)
        radius = max(1, round(math.sqrt(area) / _RADII / _STEP)) * _STEP
        if radius > _MAX_RADIUS:
            raise BadRequestError(
                f"{what}: a surface of {area:.3g} m², for which spheres of {radius:.3g} m would be used: expected "
                f"metres, and at most {_MAX_RADIUS:g} m: give the unit of its file, scale the mesh, or give a radius"
            )
    if not 0 < radius < math.inf:
        raise BadRequestError(
            f"{what}: radius {radius:g} m: expected a positive length, with which spheres cover the surface: give "
            "one, or add the vertices of the mesh instead"
        )
    longest = _LONGEST_EDGE * radius
    # An equilateral triangle has the largest area for its longest edge.
    if len(triangles) > _MAX_TRIANGLES or area > _MAX_TRIANGLES * math.sqrt(3) / 4 * longest**2:
        raise _surface_too_large(what, area, radius)
    corners, small = [triangles.reshape(-1, 3)], []
    count = 0
    while len(triangles):
        # Of equally long edges, that of the least corners is halved, whatever the order of the corners.
        order = np.lexsort(triangles.transpose(2, 0, 1)[::-1], axis=-1)
        triangles = np.take_along_axis(triangles, order[:, :, None], axis=1)
        edges = np.linalg.norm(triangles[:, [1, 2, 0]] - triangles, axis=2)
        begin = edges.argmax(axis=1)
        long = edges.max(axis=1) > longest
        count += len(triangles) - int(long.sum())
        small.append(triangles[~long])
        triangles, begin = triangles[long], begin[long]
        rows = np.arange(len(triangles))
        first, second = triangles[rows, begin], triangles[rows, (begin + 1) % 3]
        third = triangles[rows, (begin + 2) % 3]
        # Triangles that share an edge compute the same bits: the sum does not depend on the order.
        middle = (first + second) / 2
        corners.append(middle)
        halves = (first, middle, third), (middle, second, third)
        triangles = np.concatenate([np.stack(half, axis=1) for half in halves])
        if count + len(triangles) > _MAX_TRIANGLES:
            raise _surface_too_large(what, area, radius)
    points = _distinct(np.concatenate(corners))
    if len(points) > MAX_AVATAR_POINTS:
        raise _surface_too_large(what, area, radius)
    return SurfaceCover(points, radius, np.concatenate(small))


def _area(triangles: _Floats) -> float:
    """Return the area of all triangles [m²]. The order of the triangles does not change it."""
    sides = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    return math.fsum((np.linalg.norm(sides, axis=1) / 2).tolist())


def _distinct(points: _Floats) -> _Floats:
    """Return the distinct points (n, 3), sorted by x, then y, then z."""
    _, first = np.unique(_numbered(points), return_index=True)
    return np.asarray(points[first] + 0.0)  # no -0.0


def _surface_too_large(what: str, area: float, radius: float) -> TooLargeError:
    return TooLargeError(
        f"{what}: a surface of {area:.3g} m² takes more than {MAX_AVATAR_POINTS} points at a radius of {radius:g} m: "
        "expected at most that many: give a larger radius, or simplify the mesh"
    )


class ClosedParts(NamedTuple):
    """Parts of a mesh that enclose a volume.

    parts, open_parts: number of parts of the mesh, and of those that are not closed.
    closed: (m,) bool, triangles of closed parts.
    corners: (c, 3, 3) int64, even: triangles of closed parts, oriented alike in each; without those
    of two equal corners.  part: (c,) of each.  hole: (parts,) bool, whether a part is oriented
    against the largest one and may be a cavity.
    low, step: a corner is at low + corners * step / 2 [m].
    """

    parts: int
    open_parts: int
    closed: NDArray[np.bool_]
    corners: _Integers
    part: _Integers
    hole: NDArray[np.bool_]
    low: _Floats
    step: float


def closed_parts(triangles: _Floats) -> ClosedParts:
    """Find the closed parts of a mesh (m, 3, 3) [m], m >= 1.

    Triangles that share an edge are of one part. It is closed if as many of them pass along each of
    its edges in one direction as in the other, as they are or once the triangles at edges of two
    are turned alike. Equal corners are one. In a part that is open, or whose triangles all occur
    twice, as in a mesh of both sides, a triangle counts once.
    """
    low = triangles.reshape(-1, 3).min(axis=0)
    extent = float((triangles.reshape(-1, 3).max(axis=0) - low).max())
    step = 2.0 ** math.ceil(math.log2(extent / _STEPS)) if extent > 0 else 1.0
    corners = 2 * np.rint((triangles - low) / step).astype(np.int64)
    number = _numbered(corners.reshape(-1, 3)).reshape(-1, 3)
    kept = (number != np.roll(number, 1, axis=1)).all(axis=1)
    _, first, same, counts = np.unique(
        _numbered(np.sort(number, axis=1)), return_index=True, return_inverse=True, return_counts=True
    )
    again = np.ones(len(number), bool)
    again[first] = False
    rows = np.flatnonzero(kept)
    part, turn, lost, repaired = _turn_alike(number[rows])
    # Sides that lie back to back cancel out: a part of nothing else encloses no volume.
    alone = np.zeros(len(lost), bool)
    alone[part[counts[same[rows]] != 2]] = True
    if (repeated := again[rows] & (lost | ~alone)[part]).any():
        rows = rows[~repeated]
        part, turn, lost, repaired = _turn_alike(number[rows])
    is_closed = ~lost[part]
    closed = np.zeros(len(triangles), bool)
    closed[rows[is_closed]] = True
    oriented = np.where(turn[:, None, None] < 0, corners[rows][:, ::-1], corners[rows])[is_closed]
    volume = np.bincount(part[is_closed], _volumes(oriented), minlength=len(lost))
    largest = volume[np.abs(volume).argmax()] if len(volume) else 0.0
    hole = (volume * largest < 0) & ~repaired
    return ClosedParts(len(lost), int(lost.sum()), closed, oriented, part[is_closed], hole, low, step)


def _turn_alike(
    number: _Integers,
) -> tuple[_Integers, _Integers, NDArray[np.bool_], NDArray[np.bool_]]:
    """Return the part of each triangle, and 1 or -1 (to turn it); of each part, if it is open, and if turned.

    number: (n, 3), of the corners of each.
    """
    begin, end = number, np.roll(number, -1, axis=1)
    edge = _numbered(np.stack([np.minimum(begin, end), np.maximum(begin, end)], axis=-1).reshape(-1, 2))
    forward = np.where(begin < end, 1, -1).ravel()
    face = np.repeat(np.arange(len(number)), 3)
    order = np.argsort(edge, kind="stable")
    next_to = edge[order][1:] == edge[order][:-1]
    one, other = order[:-1][next_to], order[1:][next_to]
    part = _components(len(number), face[one], face[other])
    turn = np.ones(len(number), np.int64)
    lost = _open_parts(part, edge, face, forward)
    repaired = lost
    if lost.any():
        # Each triangle as it is and turned: two triangles at an edge must be of opposite
        # directions.
        alike = np.bincount(edge)[edge[one]] == 2
        one, other = one[alike], other[alike]
        same = forward[one] == forward[other]
        a, b, n = face[one], face[other], len(number)
        sheet = _components(2 * n, np.r_[a, a + n], np.r_[np.where(same, b + n, b), np.where(same, b, b + n)])
        turn = np.where(lost[part] & (sheet[:n] > sheet[n:]), -1, 1)
        lost = _open_parts(part, edge, face, forward * turn[face])
    return part, turn, lost, repaired


def fill_inside(found: ClosedParts, small: _Floats, surface: _Floats, radius: float, what: str) -> _Floats:
    """Return points (n, 3) inside closed parts, sorted, none of them in `surface` [m].

    No place inside is farther than the radius from one of them or from `surface`. Inside is what a
    part encloses. A cavity, that is a part oriented the other way within others, is outside.
    small: (k, 3, 3), the triangles of the closed parts, cut so that their edges are a few radii
    long at most [m].  surface: (s, 3) [m].  what: name of the mesh, for messages.
    Raise TooLargeError if all points are more than MAX_AVATAR_POINTS.
    """
    room = MAX_AVATAR_POINTS - len(surface)
    half = math.floor(_COVER * radius / _COVER_OF_HALF / found.step) * 2
    volume = abs(float(_volumes(found.corners)[~found.hole[found.part]].sum()))
    if half < 2 or not 0 <= volume / max(4 * half**3, 1) <= 2 * MAX_AVATAR_POINTS:
        raise _inside_too_large(what, radius)
    lattice = _Lattice(found, half)
    inside = _nodes_inside(found, lattice)
    if inside is None or len(inside) > room:
        raise _inside_too_large(what, radius)
    feet = _feet(lattice, small, inside, radius)
    points = np.concatenate([lattice.places(inside), feet]) + 0.0
    number = _numbered(np.concatenate([surface, points]))
    _, first = np.unique(number, return_index=True)
    points = points[first[first >= len(surface)] - len(surface)]
    if len(points) > room:
        raise _inside_too_large(what, radius)
    return points


class _Lattice:
    """Nodes of a lattice over a mesh: integers (i, j, k) that are all even or all odd, by number.

    half: half of its period, in halves of a step of the mesh's corners, even.
    """

    def __init__(self, found: ClosedParts, half: int) -> None:
        self.half = half
        # Two nodes on each side, so that every node near the mesh has a number.
        size = found.corners.reshape(-1, 3).max(axis=0, initial=0)
        self.counts = size // half + 9
        # Corners are even, half is even: nodes are odd, never on a corner.
        self.first = (size - (self.counts - 1) * half) // 2 | 1
        self._low, self._step = found.low, found.step / 2
        self.unit = half * self._step  # [m]

    def numbers(self, i: _Integers, j: _Integers, k: _Integers) -> _Integers:
        """Return the numbers of nodes."""
        return (i * self.counts[1] + j) * self.counts[2] + k

    def places(self, numbers: _Integers) -> _Floats:
        """Return the places (n, 3) of nodes [m]."""
        rest, k = np.divmod(numbers, self.counts[2])
        index = np.stack([*np.divmod(rest, self.counts[1]), k], axis=1)
        return self._low + (self.first + index * self.half) * self._step

    def indices(self, places: _Floats) -> _Floats:
        """Return places (n, 3) [m] in the unit and from the origin of the nodes' integers."""
        return ((places - self._low) / self._step - self.first) / self.half


def _nodes_inside(found: ClosedParts, lattice: _Lattice) -> _Integers | None:
    """Return the numbers of the nodes inside, sorted; None if they are far too many."""
    crossings = [_crossings(found, lattice, odd) for odd in (0, 1)]
    column, part, height, way = (np.concatenate(each) for each in zip(*crossings, strict=True))
    order = np.lexsort((height, column, part))
    column, part, height, way = column[order], part[order], height[order], way[order]
    # The crossings of a column and a part cancel out, so that the sum begins with 0 in each.
    within = np.flatnonzero(np.cumsum(way)[:-1] != 0)
    odd = column // lattice.counts[1] & 1
    # A node belongs to the interval that begins below it and ends at or above it.
    above = np.floor((height - odd) / 2).astype(np.int64)
    lengths = above[within + 1] - above[within]
    if lengths.sum() > 4 * MAX_AVATAR_POINTS:
        return None
    row = np.repeat(within, lengths)
    at = np.arange(len(row)) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    k = 2 * (above[row] + 1 + at) + odd[row]
    numbers, parts = column[row] * lattice.counts[2] + k, part[row]
    holes = found.hole[parts]
    solid = np.unique(numbers[~holes])
    # A part that is turned the other way and not within others is one that was exported mirrored.
    beyond = np.bincount(parts[holes], ~np.isin(numbers[holes], solid), minlength=found.parts) > 0
    weight = np.where(holes & ~beyond[parts], -1, 1)
    # Parts that overlap enclose a node once.
    nodes, of = np.unique(numbers, return_inverse=True)
    return nodes[np.bincount(of, weight, minlength=len(nodes)) > 0]


def _crossings(
    found: ClosedParts, lattice: _Lattice, odd: int
) -> tuple[_Integers, _Integers, _Floats, _Integers]:
    """Return where the columns of even or odd nodes cross the triangles.

    Return number of the column, part, height as an index of nodes, and 1 or -1 by the side.
    """
    low, high = found.corners[:, :, :2].min(axis=1), found.corners[:, :, :2].max(axis=1)
    origin = lattice.first[:2] + odd * lattice.half
    period = 2 * lattice.half
    begin, end = -((origin - low) // period), (high - origin) // period
    parts: list[tuple[_Integers, ...]] = []
    for which, column in _nodes_of(begin, end):
        place = origin + column * period
        corner = found.corners[which]
        left, areas = [], []
        for n in range(3):
            one, other = corner[:, n, :2], corner[:, (n + 1) % 3, :2]
            # Both triangles at an edge compute the same number for it.
            turned = (other[:, 0] < one[:, 0]) | ((other[:, 0] == one[:, 0]) & (other[:, 1] < one[:, 1]))
            begins, ends = np.where(turned[:, None], other, one), np.where(turned[:, None], one, other)
            along, to = ends - begins, place - begins
            area = along[:, 0] * to[:, 1] - along[:, 1] * to[:, 0]
            left.append((area >= 0) != turned)
            areas.append(np.where(turned, -area, area))
        whole = areas[0] + areas[1] + areas[2]
        met = (left[0] == left[1]) & (left[1] == left[2]) & (whole != 0)
        z = corner[met][:, :, 2].astype(np.float64)
        height = (areas[1][met] * z[:, 0] + areas[2][met] * z[:, 1] + areas[0][met] * z[:, 2]) / whole[met]
        index = 2 * column[met] + odd
        parts.append(
            (
                index[:, 0] * lattice.counts[1] + index[:, 1],
                found.part[which[met]],
                (height - lattice.first[2]) / lattice.half,
                np.where(left[0][met], 1, -1),
            )
        )
    return tuple(np.concatenate(each) for each in zip(*parts, strict=True))  # type: ignore[return-value]


def _feet(lattice: _Lattice, small: _Floats, inside: _Integers, radius: float) -> _Floats:
    """Return places (n, 3) on triangles that cover what nodes outside leave uncovered [m].

    small: (k, 3, 3) [m].  inside: sorted numbers of the nodes inside.
    """
    reach = _COVER * radius
    corners = lattice.indices(small.reshape(-1, 3)).reshape(-1, 3, 3)
    low = corners.min(axis=1) - reach / lattice.unit
    high = corners.max(axis=1) + reach / lattice.unit
    found: list[tuple[NDArray[np.generic], ...]] = []
    for odd in (0, 1):
        begin = np.ceil((low - odd) / 2).astype(np.int64)
        for which, index in _nodes_of(begin, np.floor((high - odd) / 2).astype(np.int64)):
            number = lattice.numbers(*(2 * index + odd).T)
            at_or_after = np.minimum(np.searchsorted(inside, number), max(len(inside) - 1, 0))
            outside = inside[at_or_after] != number if len(inside) else np.ones(len(number), bool)
            number, which = number[outside], which[outside]
            foot = _nearest_on(small[which], lattice.places(number))
            square = ((foot - lattice.places(number)) ** 2).sum(axis=1)
            near = square <= reach * reach
            found.append((number[near], which[near], foot[near], square[near]))
    number, which, foot, square = (np.concatenate(each) for each in zip(*found, strict=True))
    order = np.lexsort((*foot.T, square, number))
    number, which, foot, square = number[order], which[order], foot[order], square[order]
    chosen = [np.empty((0, 3))]
    while len(number):
        begins = np.r_[True, number[1:] != number[:-1]]
        chosen.append(foot[begins])
        of = np.cumsum(begins) - 1
        place, apart = foot[begins][of], square[begins][of]
        out = lattice.places(number) - place
        height = ((small[which] - place[:, None]) * out[:, None]).sum(axis=2).max(axis=1)
        covered = (height <= apart) & (2 * height <= radius * radius - reach * reach + apart)
        covered |= begins
        number, which, foot, square = (each[~covered] for each in (number, which, foot, square))
    return np.concatenate(chosen)


def _nearest_on(triangles: _Floats, places: _Floats) -> _Floats:
    """Return the place on each triangle (n, 3, 3) that is nearest to a place (n, 3)."""
    best, least = triangles[:, 0], np.full(len(places), np.inf)
    inner = np.ones(len(places), bool)
    normal = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    for n in range(3):
        corner, along = triangles[:, n], triangles[:, (n + 1) % 3] - triangles[:, n]
        to = places - corner
        length = (along * along).sum(axis=1)
        share = (to * along).sum(axis=1) / np.where(length > 0, length, 1.0)
        near = corner + np.clip(share, 0.0, 1.0)[:, None] * along
        square = ((places - near) ** 2).sum(axis=1)
        better = square < least
        best, least = np.where(better[:, None], near, best), np.minimum(least, square)
        inner &= (np.cross(along, to) * normal).sum(axis=1) >= 0
    area = (normal * normal).sum(axis=1)
    height = ((places - triangles[:, 0]) * normal).sum(axis=1) / np.where(area > 0, area, 1.0)
    foot = places - height[:, None] * normal
    better = inner & (area > 0) & (height * height * area < least)
    return np.where(better[:, None], foot, best)


def _open_parts(part: _Integers, edge: _Integers, face: _Integers, forward: _Integers) -> NDArray[np.bool_]:
    """Return for each part whether an edge is passed more often in one direction."""
    uneven = np.bincount(edge, forward) != 0
    found = np.zeros(int(part.max(initial=-1)) + 1, bool)
    found[part[face[uneven[edge]]]] = True
    return found


def _components(count: int, one: _Integers, other: _Integers) -> _Integers:
    """Return for each of `count` items the number of its connected component, from 0.

    one, other: pairs of connected items.
    """
    label = np.arange(count)
    while True:
        least = np.minimum(label[one], label[other])
        lower = label.copy()
        np.minimum.at(lower, label[one], least)
        np.minimum.at(lower, label[other], least)
        while not np.array_equal(lower, lower[lower]):
            lower = lower[lower]
        if np.array_equal(lower, label):
            return np.unique(label, return_inverse=True)[1]
        label = lower


def _numbered(rows: NDArray[np.generic]) -> _Integers:
    """Number rows (n, k) in lexicographic order; equal rows have one number."""
    number = np.zeros(len(rows), np.int64)
    for column in rows.T:
        values, rank = np.unique(column, return_inverse=True)
        number = np.unique(number * max(len(values), 1) + rank, return_inverse=True)[1]
    return number


def _volumes(corners: _Integers) -> _Floats:
    """Return the signed volume between the origin and each triangle (n, 3, 3)."""
    a, b, c = (corners[:, n].astype(np.float64) for n in range(3))
    found: _Floats = (a * np.cross(b, c)).sum(axis=1) / 6
    return found


def _nodes_of(begin: _Integers, end: _Integers) -> Iterator[tuple[_Integers, _Integers]]:
    """Yield rows (m,) and integers (m, d) from begin to end, inclusive, of each row (n, d).

    About _PAIRS at a time.
    """
    sides = np.maximum(end - begin + 1, 0)
    counts = sides.prod(axis=1)
    ends = np.cumsum(counts)
    first = 0
    while first < len(counts):
        before = ends[first] - counts[first]
        last = max(first + 1, int(np.searchsorted(ends, before + _PAIRS, side="right")))
        rows = np.repeat(np.arange(first, last), counts[first:last])
        at = np.arange(before, ends[last - 1]) - (ends - counts)[rows]
        index = np.empty((len(rows), sides.shape[1]), np.int64)
        for axis in reversed(range(sides.shape[1])):
            at, index[:, axis] = np.divmod(at, sides[rows, axis])
        yield rows, begin[rows] + index
        first = last


def _inside_too_large(what: str, radius: float) -> TooLargeError:
    return TooLargeError(
        f"{what}: filled, it takes more than {MAX_AVATAR_POINTS} points at a radius of {radius:g} m: expected at "
        "most that many: give `hollow`, which leaves its inside empty, or a larger radius"
    )
