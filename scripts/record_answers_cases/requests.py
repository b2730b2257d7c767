"""About 20,000 exact requests of all queries, in groups, made from the points of the archives."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .plain_numbers import FINE, Avatar, Dice, Floats, poses_of, rotations, turned

QUERIES = ("collide", "distance", "contacts", "sweep", "raycast", "within", "objects")
PATHS = ("collide", "distance", "contacts", "sweep")
ROLES = ("figure", "shell", "rod", "dot")
MARGINS = (0.0, 0.0, 0.03, 0.2)
REACHES = (1.0, 0.25, 3.0)
PATH_POSES = 60
OBJECTS = 6


class Group(NamedTuple):
    """Requests of one query with the same parameters.

    method: the query, or path.  arrays: what differs by request; row i of each belongs to request i.
    avatar: "" for rays and points.  options: the query's remaining parameters.
    """

    name: str
    method: str
    avatar: str
    arrays: tuple[Any, ...]
    options: dict[str, Any]

    @property
    def size(self) -> int:
        """Return the number of requests."""
        return len(self.arrays[0]) - (self.options.get("op") == "sweep")

    def rows(self, stride: int) -> "Group":
        """Return the group with every `stride`-th request only; a path stays whole."""
        if self.method == "path" or stride == 1:
            return self
        return self._replace(arrays=tuple(each[::stride] for each in self.arrays))


def make_groups(
    scene: str, points: Floats, avatars: dict[str, Avatar], models: Sequence[str | None], count: int
) -> list[Group]:
    """Return about `count` requests at a scene, in groups.

    points: (n, 3) of the scene's scans, world [m], in an order that does not depend on the archive.
    models: radius models; None: the scene's default.
    """
    number = sum(map(ord, scene))
    each = (count - len(PATHS) * PATH_POSES) // (len(QUERIES) * len(models))
    groups = []
    for m, model in enumerate(models):
        more = {} if model is None else {"radius_model": model}
        for q, query in enumerate(QUERIES):
            role = ROLES[(m + q) % len(ROLES)]
            dice = Dice(number, m, q)
            name = f"{scene} {query} {model or 'default'}"
            groups.append(_group(name, query, role, avatars, points, dice, each, m + q, more))
    for p, op in enumerate(PATHS):
        dice = Dice(number, 1000 + p)
        places = points[dice.integers(0, len(points), 4)]
        middle = [places[0] + (places[1] - places[0]) * (k / PATH_POSES) for k in range(PATH_POSES)]
        turn = np.repeat(rotations(2 * dice.integers(-9, 9, 1, 4) + 1), PATH_POSES, axis=0)
        poses = poses_of(turn, _rounded(np.array(middle)))
        groups.append(Group(f"{scene} path {op}", "path", ROLES[p], (poses,), {"op": op}))
    return groups


def _group(
    name: str,
    query: str,
    role: str,
    avatars: dict[str, Avatar],
    points: Floats,
    dice: Dice,
    count: int,
    number: int,
    more: dict[str, Any],
) -> Group:
    """Return one group; `number` chooses margin and reach."""
    margin, reach = MARGINS[number % len(MARGINS)], REACHES[number % len(REACHES)]
    if query in ("raycast", "within"):
        far = 8192 if query == "raycast" else 1024
        places = _rounded(
            points[dice.integers(0, len(points), count)] + dice.integers(-far, far, count, 3) / 2048
        )
        if query == "within":
            return Group(name, query, "", (places,), {"reach": reach, **more})
        # Every second ray aims at a scan point, the others anywhere.
        aims = points[dice.integers(0, len(points), count)] - places
        aims[1::2] = 2 * dice.integers(-50, 50, len(aims[1::2]), 3) + 1
        return Group(name, query, "", (places, aims), {"reach": 30.0, **more})
    poses = near_poses(points, avatars[role], dice, count)
    if query == "sweep":
        # Motions end near scan points. A third are translations, a third turn too, and a third come from
        # anywhere. Most begin farther away than they reach, every fifth near a scan point.
        starts = near_poses(points, avatars[role], dice, count)
        starts[0::3, :3, :3] = poses[0::3, :3, :3]
        for k in (0, 1):
            starts[k::3, :3, 3] = poses[k::3, :3, 3] + dice.integers(-3072, 3073, len(starts[k::3]), 3) / 1024
        starts[2::3, :3, 3] += dice.integers(-3072, 3073, len(starts[2::3]), 3) / 1024
        starts[::5, :3, 3] = poses[::5, :3, 3] + dice.integers(-256, 257, len(starts[::5]), 3) / 1024
        starts[:, :3, 3] = _rounded(starts[:, :3, 3])
        return Group(name, query, role, (starts, poses), {"margin": margin, **more})
    if query == "objects":
        others = near_poses(points, avatars[role], dice, count * OBJECTS).reshape(count, OBJECTS, 4, 4)
        # The objects of a request stand close together.
        others[:, :, :3, 3] = _rounded(
            poses[:, None, :3, 3] + dice.integers(-512, 513, count, OBJECTS, 3) / 1024
        )
        return Group(name, query, role, (others,), {"margin": margin, **more})
    options: dict[str, Any] = {"margin": margin}
    if query == "distance":
        options = {"reach": reach}
    elif query == "contacts":
        options |= {"limit": (100, 7, 0)[number % 3], "cluster_distance": (None, 0.2, 0.05)[number % 3]}
    return Group(name, query, role, (poses,), {**options, **more})


def near_poses(points: Floats, avatar: Avatar, dice: Dice, count: int) -> Floats:
    """Return poses (count, 4, 4), most of which put an avatar point near a scan point.

    Half of the rotations are about z, an eighth are none.
    """
    quaternions = dice.integers(-40, 41, count, 4)
    quaternions[::2, 1:3] = 0
    quaternions[::8] = 0
    quaternions[(quaternions == 0).all(axis=1)] = [1, 0, 0, 0]
    turns = rotations(quaternions)
    own = avatar.points[dice.integers(0, len(avatar.points), count)]
    # Offsets up to 1/8 m, 1/4 m and 2 m; every tenth puts the two points on each other.
    offsets = dice.integers(-512, 513, count, 3) / 4096
    offsets[1::3] *= 2
    offsets[::3] *= 16
    offsets[::10] = 0
    return poses_of(
        turns, _rounded(points[dice.integers(0, len(points), count)] - turned(turns, own) + offsets)
    )


def _rounded(places: Floats) -> Floats:
    """Return places as multiples of FINE."""
    return np.rint(places / FINE) * FINE
