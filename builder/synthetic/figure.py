"""Points on the surface of a walking human figure: the avatar of the generated scenes.

The paper's avatar is a polygonal figure taken as 3,617 points ([Fig12], section 3). This figure
consists of capsules and ellipsoids. Frame: metres, z up, origin on the floor between the feet,
facing +y.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...schemas.errors import BadRequestError
from ...schemas.runtime.new_file import new_file

# Height that the proportions are given for [m]; other heights scale the whole figure.
HEIGHT = 1.75
# Candidates per kept point: more give a more even spacing and take longer. With 10 the least
# spacing is 0.86 of the mean.
CANDIDATES = 10
Vector = tuple[float, float, float]


class Capsule(NamedTuple):
    """Round limb: a segment from `a` to `b` [m], its radius tapering from `radius_a` to `radius_b`."""

    a: Vector
    b: Vector
    radius_a: float
    radius_b: float


class Ellipsoid(NamedTuple):
    """Axis-aligned ellipsoid: centre and half axes [m]."""

    centre: Vector
    half: Vector


def _body() -> tuple[Capsule | Ellipsoid, ...]:
    """Return the parts, for HEIGHT; left leg and right arm forward."""
    parts: list[Capsule | Ellipsoid] = [
        Ellipsoid((0, 0.01, 1.640), (0.076, 0.098, 0.110)),
        Capsule((0, -0.01, 1.46), (0, 0.0, 1.55), 0.058, 0.055),
        Ellipsoid((0, 0.0, 1.290), (0.172, 0.112, 0.215)),
        Ellipsoid((0, 0.005, 1.100), (0.140, 0.100, 0.180)),
        Ellipsoid((0, -0.01, 0.950), (0.168, 0.115, 0.125)),
    ]
    for side in (-1, 1):
        arm, leg = -0.20 * side, 0.24 * side
        shoulder, elbow = (side * 0.180, 0.0, 1.420), (side * 0.212, 0.45 * arm, 1.145)
        wrist = (side * 0.216, 0.45 * arm + 0.70 * arm + 0.06, 0.905)
        hand = (side * 0.210, wrist[1] + 0.025, 0.850)
        parts += [Capsule(shoulder, elbow, 0.056, 0.044), Capsule(elbow, wrist, 0.043, 0.030)]
        parts.append(Ellipsoid(hand, (0.026, 0.045, 0.085)))
        hip, ankle = (side * 0.090, 0.0, 0.900), (side * 0.085, leg - 0.05, 0.085)
        knee = (side * 0.092, 0.55 * leg + 0.03, 0.490)
        parts += [Capsule(hip, knee, 0.086, 0.058), Capsule(knee, ankle, 0.057, 0.040)]
        # Heel and toes; `_surface` flattens the sole at z = 0.
        heel, toes = (side * 0.085, leg - 0.075, 0.035), (side * 0.095, leg + 0.115, 0.025)
        parts.append(Capsule(heel, toes, 0.042, 0.035))
    return tuple(parts)


def figure_points(points: int = 3617, seed: int = 2012, height: float = HEIGHT) -> NDArray[np.float64]:
    """Return exactly `points` points (n, 3) [m], spread evenly over the surface of the figure.

    Candidates are drawn by area from every part; those inside another part are dropped. The
    candidate farthest from all chosen points is chosen next: spacing is even, and any prefix covers
    the whole figure. The lowest point is at z = 0, the highest at `height`. Raises BadRequestError
    for a number of points or a height out of range.
    """
    if not 1 <= points <= 100_000 or not 0.1 <= height <= 10:
        raise BadRequestError(
            f"figure of {points} points, {height} m tall: expected 1 to 100000 points and 0.1 to 10 m: "
            "choose values in these ranges"
        )
    rng = np.random.default_rng([seed, 0xF16])
    candidates = _surface(max(CANDIDATES * points, 20_000), rng)
    low, high = candidates[:, 2].min(), candidates[:, 2].max()
    candidates[:, 2] -= low
    return _spread(candidates, points) * float(height / (high - low))


def half_width(points: NDArray[np.float64]) -> float:
    """Return the largest distance of the points from the figure's axis to its sides [m]."""
    return float(np.abs(points[:, 0]).max())


def write_figure(path: Path, points: NDArray[np.float64]) -> None:
    """Write points as the vertices of an OBJ or ASCII PLY file; the digits read back to the same bits."""
    suffix = path.suffix.lower()
    if suffix == ".obj":
        head, lead = "# points of a figure, metres, z up\n", "v "
    elif suffix == ".ply":
        columns = "".join(f"property double {axis}\n" for axis in "xyz")
        head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{columns}end_header\n"
        lead = ""
    else:
        raise BadRequestError(f"{path}: cannot write {suffix!r}: expected .obj or .ply: rename the output")
    rows = "".join(f"{lead}{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist())
    path.parent.mkdir(parents=True, exist_ok=True)
    with new_file(path) as file:
        file.write((head + rows).encode("ascii"))


def _surface(count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Return about `count` points on the surface of the union, even by area."""
    parts = _body()
    areas = np.array([_area(part) for part in parts])
    # About a third lies inside other parts at the joints: draw more.
    draws = np.ceil(1.4 * count * areas / areas.sum()).astype(int)
    kept = []
    for k, (part, n) in enumerate(zip(parts, draws, strict=True)):
        drawn = _sample(part, int(n), rng)
        buried = np.zeros(len(drawn), bool)
        for other in parts[:k] + parts[k + 1 :]:
            buried |= _inside(other, drawn)
        kept.append(drawn[~buried])
    cloud = np.concatenate(kept)
    # Soles: project points below the floor onto it.
    cloud[:, 2] = np.maximum(cloud[:, 2], 0.0)
    return cloud


def _area(part: Capsule | Ellipsoid) -> float:
    """Return the area of a part [m2]; an ellipsoid's by Thomsen's formula, within 1.1 %."""
    if isinstance(part, Ellipsoid):
        a, b, c = (h**1.6075 for h in part.half)
        return float(4 * np.pi * ((a * b + a * c + b * c) / 3) ** (1 / 1.6075))
    length = float(np.linalg.norm(np.subtract(part.b, part.a)))
    return float(
        np.pi * (part.radius_a + part.radius_b) * length + 2 * np.pi * (part.radius_a**2 + part.radius_b**2)
    )


def _sample(part: Capsule | Ellipsoid, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
    """Draw `count` points on a part's surface, even by area."""
    ball: NDArray[np.float64] = rng.normal(size=(count, 3))
    ball /= np.linalg.norm(ball, axis=1)[:, None]
    if isinstance(part, Ellipsoid):
        half = np.asarray(part.half)
        # Scaling the unit ball stretches areas unevenly: keep each direction in proportion to its
        # local area.
        weight = np.linalg.norm(ball / half, axis=1) * half.min()
        kept = rng.choice(count, count, p=weight / weight.sum())
        stretched: NDArray[np.float64] = (ball * half)[kept] + np.asarray(part.centre)
        return stretched
    a, b = np.asarray(part.a), np.asarray(part.b)
    length = float(np.linalg.norm(b - a))
    axis = (b - a) / length
    side = np.pi * (part.radius_a + part.radius_b) * length
    caps = 2 * np.pi * np.array([part.radius_a**2, part.radius_b**2])
    kind = rng.choice(3, count, p=np.array([side, *caps]) / (side + caps.sum()))
    along = rng.uniform(size=count)
    radius = part.radius_a + along * (part.radius_b - part.radius_a)
    around = ball - (ball @ axis)[:, None] * axis
    around /= np.linalg.norm(around, axis=1)[:, None]
    out: NDArray[np.float64] = a + axis * (along * length)[:, None] + around * radius[:, None]
    outward = np.sign(ball @ axis)[:, None]
    for which, end, radius_end, way in ((1, a, part.radius_a, -1.0), (2, b, part.radius_b, 1.0)):
        cap = end + ball * outward * way * radius_end
        out[kind == which] = cap[kind == which]
    return out


def _inside(part: Capsule | Ellipsoid, cloud: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return which points lie inside a part, by more than 0.1 mm."""
    hair = 1e-4
    inside: NDArray[np.bool_]
    if isinstance(part, Ellipsoid):
        inside = (((cloud - part.centre) / (np.asarray(part.half) - hair)) ** 2).sum(axis=1) < 1
        return inside
    a, b = np.asarray(part.a), np.asarray(part.b)
    along = np.clip((cloud - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
    radius = part.radius_a + along * (part.radius_b - part.radius_a) - hair
    inside = ((cloud - a - along[:, None] * (b - a)) ** 2).sum(axis=1) < radius * radius
    return inside


def _spread(cloud: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Choose `count` points of the cloud, each the farthest from those before it."""
    chosen = np.empty(count, np.int64)
    nearest = np.full(len(cloud), np.inf)
    columns = np.ascontiguousarray(cloud.T)
    chosen[0] = int(columns[2].argmax())
    for k in range(1, count):
        x, y, z = columns[:, chosen[k - 1]]
        distance = (columns[0] - x) ** 2 + (columns[1] - y) ** 2 + (columns[2] - z) ** 2
        np.minimum(nearest, distance, out=nearest)
        chosen[k] = int(nearest.argmax())
    return cloud[chosen]
