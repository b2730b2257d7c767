"""The sessions: a scene file each, and the motion commands of its users.

Places are in metres. The façade's door is at x = 0, y = 0 to 1.2, behind three steps up from
y = -2.1; its forecourt lies at z = 0 and its nave at z = 0.45. `truth.py` of the generated façade
gives further places.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .plain_numbers import UNIT, Floats, Integers, along, poses_of, rotations, turned, upright

Command = dict[str, Any]
Archives = tuple[tuple[str, Floats | None], ...]
ALL = "stop sweep slide step ground"
# Feet above the floor [m].
FEET = 0.03
# Pose of the town in scenes of two archives: 3-4-5 turned about z, its forecourt near the façade's.
BESIDE = poses_of(rotations(np.array([[3, 0, 0, 1]])), np.array([[-6.0, -24.0, 0.06]]))[0]


class User(NamedTuple):
    """User of a session. commands: arguments of `wish`, one a frame."""

    avatar: str
    commands: Sequence[Command]


class Session(NamedTuple):
    """Session: archives by name with their poses, what its scene file adds to them, and its users.

    small_cache: whether the cache holds a few voxels only.
    """

    name: str
    archives: Archives
    effects: str
    users: tuple[User, ...]
    more: str = ""
    head: str = ""
    small_cache: bool = False

    def scene_file(self, paths: dict[str, str]) -> str:
        """Return the scene file. paths: of archives and avatars, by name."""
        lines = ["format = 1", self.head]
        for name, pose in self.archives:
            lines += ["[[archives]]", f'path = "{paths[name]}"']
            lines += [] if pose is None else [f"pose = {pose.tolist()}"]
        for avatar, radius in AVATARS.items():
            lines += ["[[avatars]]", f'name = "{avatar}"', f'file = "{paths[avatar]}"', f"radius = {radius}"]
        for effect in self.effects.split():
            name, _, settings = effect.partition(":")
            lines += ["[[effects]]", f'effect = "{name}"', *settings.split(";")]
        return "\n".join([*lines, self.more, ""])


AVATARS = {"person": 0.07, "figure": 0.03, "box": 0.06}


def walk_of(
    place: tuple[float, float, float], *legs: tuple[int, tuple[float, float, float], float]
) -> list[Command]:
    """Return commands: begin at a place, then (frames, velocity [m/s], turn [rad/s]) one after another."""
    first: Command = {"pose": upright(np.array([place]))}
    return [
        first,
        *({"velocity": speed, "turn": turn} for frames, speed, turn in legs for _ in range(frames)),
    ]


def line_of(begin: tuple[float, float, float], end: tuple[float, float, float], step: float) -> list[Command]:
    """Return commands of poses along a straight line, at most `step` [m] apart."""
    return [{"pose": pose[None]} for pose in upright(along([begin, end], step))]


def make_sessions(walk: Integers) -> list[Session]:
    """Return the sessions in generated scans.

    walk: (k, 5) a walk through the façade: place [UNIT], and (w, z) of the quaternion.
    """
    facade: Archives = (("facade", None),)
    town: Archives = (("town", None),)
    grid: Archives = (("grid", None),)
    both: Archives = (("facade", None), ("town", BESIDE))
    quaternions = np.stack([walk[:, 3], 0 * walk[:, 3], 0 * walk[:, 3], walk[:, 4]], axis=1)
    walked = [{"pose": pose[None]} for pose in poses_of(rotations(quaternions), walk[:, :3] * UNIT)]
    ahead, back, right, left = (0.0, 1.4, 0.0), (0.0, -1.4, 0.0), (1.4, 0.0, 0.0), (-1.4, 0.0, 0.0)
    door = walk_of((0.2, -4.0, FEET), (130, ahead, 0.0), (30, right, 0.5), (40, back, 0.0))
    jamb = walk_of((1.0, -4.0, FEET), (140, ahead, 0.0))
    objects = "".join(
        f'[[objects]]\nname = "{name}"\navatar = "box"\nkind = "{kind}"\npose = {pose.tolist()}\n'
        for (name, kind), pose in zip(
            (("crate", "pushed"), ("second", "pushed"), ("gate", "kinematic")),
            upright(np.array([(-0.3, -8.0, 0.08), (0.1, -6.6, 0.08), (2.2, -7.0, 0.2)])),
            strict=True,
        )
    )
    gates = upright(along([(2.2, -7.0, 0.2), (0.8, -7.0, 0.2), (0.8, -5.0, 0.2)], 0.04), (20, 1))
    pushing = walk_of((0.0, -10.0, FEET), (150, (0.0, 1.1, 0.0), 0.0), (40, (0.7, 0.7, 0.0), 0.2))
    moving = walk_of((2.4, -9.4, FEET), (len(gates), (0.0, 0.9, 0.0), 0.0))
    moving[1:] = [
        command | {"objects": {"gate": gate}} for command, gate in zip(moving[1:], gates, strict=True)
    ]
    boxes = 'through:boxes=[{name="jamb",low=[0.5,-1.6,0.3],high=[1.7,1.6,3.2]}]'
    crowd = tuple(
        User("person", walk_of(place, (110, way, 0.0), (40, back, 0.3)))
        for place, way in (
            ((0.2, -4.2, FEET), ahead),
            ((0.9, -5.0, FEET), (-0.3, 1.6, 0.0)),
            ((-0.8, -5.2, FEET), (0.4, 1.5, 0.0)),
        )
    )
    reports = "proximity:reach=0.4 contacts:margin=0.03;limit=5"
    wide, coarse = "slide:normal_reach=0.2", "sweep:tolerance=0.001"
    steep = "step:height=0.25 ground:slope=50.0;snap=0.3"
    pushers = User("person", pushing), User("person", moving)
    wall = line_of((1.2, -4.0, 0.1), (3.0, -0.2, 0.6), 0.06)
    cloister = walk_of((-8.2, -14.0, 0.05), (120, (-0.6, 1.3, 0.0), 0.4))
    column = walk_of((-4.6, -7.0, 0.05), (60, ahead, 0.3), (60, right, -1.0))
    fall = walk_of((-3.0, -9.0, 4.0), (60, (0.2, 0.1, 0.0), 0.0))
    down = walk_of((0.3, 0.6, 0.48), (110, back, 0.0), (20, left, 0.0))
    inside = walk_of((-8.9, -10.0, 0.04), (30, ahead, 0.0), (50, right, 0.0))
    beside = walk_of((-3.0, -13.0, 0.3), (90, (-0.7, -1.2, 0.0), 0.2), (60, ahead, 0.0))
    above = walk_of((-1.0, -12.0, 0.2), (90, (-0.5, -1.0, 0.0), 0.0))
    street = walk_of((20.1, -5.0, 0.2), (130, ahead, 0.0), (40, right, 0.0))
    corner = walk_of((2.75, 2.5, 0.5), (60, (1.0, 1.0, 0.0), 0.0), (60, (0.5, 1.0, 0.0), 0.3))

    def alone(
        name: str, archives: Archives, effects: str, body: str, commands: list[Command], **more: Any
    ) -> Session:
        return Session(name, archives, effects, (User(body, commands),), **more)

    return [
        alone("walk at a wall, stop alone", facade, "stop", "figure", wall),
        alone("generated walk", facade, ALL, "person", walked),
        alone("generated walk, reports", facade, f"stop sweep slide {reports}", "figure", walked),
        alone("through the door", facade, f"{ALL} {reports}", "person", door),
        alone("off the jamb", facade, f"stop sweep {wide} step ground", "person", jamb),
        alone("along the cloister", facade, f"stop:skin=0.005 {coarse} slide:surfaces=2", "person", cloister),
        alone("turning at a column", facade, f"stop sweep {wide}", "figure", column),
        alone("a fall", facade, f"{ALL} {reports}", "person", fall),
        alone("down the stairs", facade, f"stop sweep slide {steep}", "person", down),
        Session("a crowd at the door", facade, f"{ALL} crowd:margin=0.1", crowd),
        Session("objects pushed and moved", facade, f"{ALL} objects", pushers, objects),
        Session("objects and a crowd", facade, f"{ALL} objects crowd {reports}", (pushers[0], *crowd[1:]), objects),
        alone("through a box", facade, f"{ALL} {boxes}", "person", jamb),
        alone("local radii", facade, ALL, "person", door, head='radius_model = "local"'),
        alone("border radii, uncertainty", facade, f"{ALL} uncertainty:sigma=0.02", "person", jamb,
              head='radius_model = "local+border:1.2"'),
        alone("in contact at first", facade, ALL, "person", inside),
        alone("two archives", both, f"{ALL} {reports}", "person", beside),
        alone("two archives, uncertainty", both, "stop sweep slide uncertainty:sigma=0.03", "figure", above),
        alone("a small cache", facade, ALL, "person", door, small_cache=True),
        alone("in a town", town, f"{ALL} {reports} uncertainty:sigma=0.01", "person", street),
        alone("ties in a grid", grid, f"{ALL} {reports}", "box", corner),
    ]  # fmt: skip


def make_real_sessions() -> list[Session]:
    """Return the sessions in the real scan `atrium`: a two-storey building, y up, its floor at y = -1.32."""
    corridor = [
        (-14.04, 1.5),
        (-12.8, 1.85),
        (-11.1, 2.05),
        (-9.9, 2.75),
        (-8.5, 3.25),
        (-6.7, 3.35),
        (-3.0, 3.5),
    ]
    passage = [
        (-3.0, 3.5),
        (-3.84, 3.15),
        (-2.74, 2.6),
        (-1.94, 1.75),
        (-0.69, 1.35),
        (0.21, 2.1),
        (1.31, 2.65),
    ]
    # A quarter turn about x, which takes the avatar's z to y.
    rise = rotations(np.array([[1, -1, 0, 0]]))[0]

    def route(corners: list[tuple[float, float]], floor: float) -> list[Command]:
        places = along([(x, floor, z) for x, z in corners], 0.047)
        return [{"pose": pose[None]} for pose in poses_of(np.repeat(rise[None], len(places), axis=0), places)]

    sessions = []
    for name, corners, effects in (
        ("real corridor", corridor, ALL),
        ("real passage", passage, f"{ALL} proximity contacts:margin=0.02"),
        (
            "real walls",
            [(-14.0, 1.5), (-14.0, -0.4), (-13.0, 2.9), (-12.0, 3.9)],
            "stop sweep slide uncertainty",
        ),
    ):
        commands = route(corners, -1.25)
        archives = (("atrium", None),)
        sessions.append(
            Session(name, archives, effects, (User("person", commands),), head="up = [0.0, 1.0, 0.0]")
        )
    assert np.allclose(turned(rise, np.array([0.0, 0.0, 1.0])), [0.0, 1.0, 0.0])
    return sessions
