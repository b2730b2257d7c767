"""Twenty sessions: a scene file each, and the motion commands of its users.

Places are in metres. The façade's door is at x = 0, y = 0 to 1.2, behind three steps up from
y = -2.1; its forecourt lies at z = 0 and its nave at z = 0.45. `truth.py` of the generated façade
gives further places.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from .plain_numbers import UNIT, Floats, Integers, along, poses_of, rotations, turned, upright

Command = dict[str, Any]
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
    archives: tuple[tuple[str, Floats | None], ...]
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


def towards(*legs: tuple[int, tuple[float, float, float], float]) -> list[Command]:
    """Return commands of velocities: (frames, velocity [m/s], turn [rad/s]) one after another."""
    return [{"velocity": speed, "turn": turn} for frames, speed, turn in legs for _ in range(frames)]


def begin(place: tuple[float, float, float], heading: tuple[int, int] = (1, 0)) -> list[Command]:
    """Return the command that puts a user at a place."""
    return [{"pose": upright(np.array([place]), heading)}]


def through(
    corners: list[tuple[float, float, float]], step: float, heading: tuple[int, int] = (1, 0)
) -> list[Command]:
    """Return commands of poses along straight lines between corners, at most `step` [m] apart."""
    return [{"pose": pose[None]} for pose in upright(along(corners, step), heading)]


def make_sessions(walk: Integers) -> list[Session]:
    """Return the sessions in generated scans.

    walk: (k, 5) a walk through the façade: place [UNIT], and (w, z) of the quaternion.
    """
    facade, town, grid = (("facade", None),), (("town", None),), (("grid", None),)
    both = (("facade", None), ("town", BESIDE))
    quaternions = np.stack([walk[:, 3], 0 * walk[:, 3], 0 * walk[:, 3], walk[:, 4]], axis=1)
    walked = [{"pose": pose[None]} for pose in poses_of(rotations(quaternions), walk[:, :3] * UNIT)]
    ahead, back, right, left = (0.0, 1.4, 0.0), (0.0, -1.4, 0.0), (1.4, 0.0, 0.0), (-1.4, 0.0, 0.0)
    door = begin((0.2, -4.0, FEET)) + towards((130, ahead, 0.0), (30, right, 0.5), (40, back, 0.0))
    jamb = begin((1.0, -4.0, FEET)) + towards((140, ahead, 0.0))
    objects = "".join(
        f'[[objects]]\nname = "{name}"\navatar = "box"\nkind = "{kind}"\npose = {pose.tolist()}\n'
        for (name, kind), pose in zip(
            (("crate", "pushed"), ("second", "pushed"), ("gate", "kinematic")),
            upright(np.array([(-0.3, -8.0, 0.08), (0.1, -6.6, 0.08), (2.2, -7.0, 0.2)])),
            strict=True,
        )
    )
    gates = upright(along([(2.2, -7.0, 0.2), (0.8, -7.0, 0.2), (0.8, -5.0, 0.2)], 0.04), (20, 1))
    pushing = begin((0.0, -10.0, FEET)) + towards((150, (0.0, 1.1, 0.0), 0.0), (40, (0.7, 0.7, 0.0), 0.2))
    moving = begin((2.4, -9.4, FEET)) + [
        command | {"objects": {"gate": gate}}
        for command, gate in zip(towards((len(gates), (0.0, 0.9, 0.0), 0.0)), gates, strict=True)
    ]
    boxes = 'through:boxes=[{name="jamb",low=[0.5,-1.6,0.3],high=[1.7,1.6,3.2]}]'
    apart = [begin((x, y, z)) for x, y, z in ((0.2, -4.2, FEET), (0.9, -5.0, FEET), (-0.8, -5.2, FEET))]
    crowd = tuple(
        User("person", [*first, *towards((110, way, 0.0), (40, back, 0.3))])
        for first, way in zip(apart, (ahead, (-0.3, 1.6, 0.0), (0.4, 1.5, 0.0)), strict=True)
    )
    reports = "proximity:reach=0.4 contacts:margin=0.03;limit=5"
    wide = "slide:normal_reach=0.2"
    return [
        Session("walk at a wall, stop alone", facade, "stop", (User("figure", through([(1.2, -4, 0.1), (3, -0.2, 0.6)], 0.06)),)),
        Session("generated walk", facade, ALL, (User("person", walked),)),
        Session("generated walk, reports", facade, f"stop sweep slide {reports}", (User("figure", walked),)),
        Session("through the door", facade, f"{ALL} {reports}", (User("person", door),)),
        Session("off the jamb", facade, f"stop sweep {wide} step ground", (User("person", jamb),)),
        Session("along the cloister", facade, "stop:skin=0.005 sweep:tolerance=0.001 slide:surfaces=2",
                (User("person", begin((-8.2, -14.0, 0.05)) + towards((120, (-0.6, 1.3, 0.0), 0.4))),)),
        Session("turning at a column", facade, f"stop sweep {wide}",
                (User("figure", begin((-4.6, -7.0, 0.05)) + towards((60, ahead, 0.3), (60, right, -1.0))),)),
        Session("a fall", facade, f"{ALL} {reports}",
                (User("person", begin((-3.0, -9.0, 4.0)) + towards((60, (0.2, 0.1, 0.0), 0.0))),)),
        Session("down the stairs", facade, "stop sweep slide step:height=0.25 ground:slope=50.0;snap=0.3",
                (User("person", begin((0.3, 0.6, 0.48)) + towards((110, back, 0.0), (20, left, 0.0))),)),
        Session("a crowd at the door", facade, f"{ALL} crowd:margin=0.1", crowd),
        Session("objects pushed and moved", facade, f"{ALL} objects", (User("person", pushing), User("person", moving)), objects),
        Session("objects and a crowd", facade, f"{ALL} objects crowd {reports}",
                (User("person", pushing), *crowd[1:]), objects),
        Session("through a box", facade, f"{ALL} {boxes}", (User("person", jamb),)),
        Session("local radii", facade, ALL, (User("person", door),), head='radius_model = "local"'),
        Session("border radii, uncertainty", facade, f"{ALL} uncertainty:sigma=0.02", (User("person", jamb),),
                head='radius_model = "local+border:1.2"'),
        Session("in contact at first", facade, ALL,
                (User("person", begin((-8.9, -10.0, 0.04)) + towards((30, ahead, 0.0), (50, right, 0.0))),)),
        Session("two archives", both, f"{ALL} {reports}",
                (User("person", begin((-3.0, -13.0, 0.3)) + towards((90, (-0.7, -1.2, 0.0), 0.2), (60, ahead, 0.0))),)),
        Session("two archives, uncertainty", both, "stop sweep slide uncertainty:sigma=0.03",
                (User("figure", begin((-1.0, -12.0, 0.2)) + towards((90, (-0.5, -1.0, 0.0), 0.0))),)),
        Session("a small cache", facade, ALL, (User("person", door),), small_cache=True),
        Session("in a town", town, f"{ALL} {reports} uncertainty:sigma=0.01",
                (User("person", begin((20.1, -5.0, 0.2)) + towards((130, ahead, 0.0), (40, right, 0.0))),)),
        Session("ties in a grid", grid, f"{ALL} {reports}",
                (User("box", begin((2.75, 2.5, 0.5)) + towards((60, (1.0, 1.0, 0.0), 0.0), (60, (0.5, 1.0, 0.0), 0.3))),)),
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
