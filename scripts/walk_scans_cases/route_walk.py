"""Walk of one route: motion commands towards the waypoints, in a session that is recorded to a log."""

import math
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from solidcloud.schemas.wire.motion_messages import State
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.replay import check_same, recorded, replay
from solidcloud.server.simulation.replay_log import read_log

from .persons import Person
from .routes import Leg, Route, Scan

Floats = NDArray[np.float64]

AVATAR, FRAME = "person", 1 / 30
# Height of the feet above the floor at the start, and frames in which the person comes to rest [m].
_DROP, _SETTLE_FRAMES = 0.05, 15
# A waypoint is reached within this horizontal distance [m].
REACH = 0.15
# A leg may take this many times its frames without obstacles, and this many more.
_PATIENCE, _EXTRA_FRAMES = 3.0, 60
# A person who moves less than _STILL [m] in _STILL_FRAMES frames is stuck.
_STILL, _STILL_FRAMES = 1e-3, 20
# Fastest turn of the person towards the way [rad/s].
_TURN = 3.0


class Command(NamedTuple):
    """Motion command of a frame. velocity: (3,) [m/s].  turn: about the vertical axis [rad/s]."""

    velocity: Floats
    turn: float


class Walked(NamedTuple):
    """A walk of k frames.

    commands: of each frame.  poses: (k, 4, 4), the person after each frame.
    states: of each frame.  leg: (k,) number of the leg of each frame.
    ended: number of reached waypoints.  why: "reached", "stuck" or "slow".
    """

    commands: list[Command]
    poses: Floats
    states: list[State]
    leg: NDArray[np.int64]
    ended: int
    why: str

    def touching(self) -> NDArray[np.bool_]:
        """Return the frames (k,) in which a surface stopped a motion."""
        return np.array([bool(state.touched) for state in self.states])


def scene_text(archive: Path, scan: Scan) -> str:
    """Return a scene file of a scan's archive with the five effects of walking."""
    options = {"stop": "", "sweep": "", "slide": "", "step": f"height = {scan.step}\n", "ground": ""}
    effects = "".join(f'\n[[effects]]\neffect = "{name}"\n{option}' for name, option in options.items())
    return f'format = 1\nup = {scan.up_vector().tolist()}\n\n[[archives]]\npath = "{archive}"\n{effects}'


def first_pose(scan: Scan, route: Route) -> Floats:
    """Return the pose (4, 4) of the person at the start of a route, upright, above the floor."""
    pose = np.eye(4)
    if scan.up == 1:  # from z up to y up
        pose[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]
    pose[:3, 3] = scan.place(route.start, route.floor + _DROP)
    return pose


def command_towards(pose: Floats, leg: Leg, scan: Scan, speed: float) -> tuple[Command, float]:
    """Return the motion command from a pose (4, 4) towards a waypoint, and the distance to it [m]."""
    up = scan.up_vector()
    way = scan.place(leg.to, 0.0) - pose[:3, 3]
    way -= (way @ up) * up
    far = float(np.linalg.norm(way))
    way /= max(far, 1e-9)
    lean = math.radians(leg.lean)
    way = math.cos(lean) * way + math.sin(lean) * np.cross(up, way)
    face = pose[:3, 1]
    angle = math.atan2(float(up @ np.cross(face, way)), float(face @ way))
    return Command(way * speed, max(-_TURN, min(angle / FRAME, _TURN))), far


def walk_route(scene: Scene, scan: Scan, route: Route, person: Person) -> Walked:
    """Walk a route in a session of the scene."""
    # Without it, the first frame may compile for longer than the simulation waits for silent users.
    scene.simulation.warm()
    scene.add_avatar(AVATAR, person.points, person.radius)
    commands: list[Command] = []
    states: list[State] = []
    legs: list[int] = []
    pose, why, reached = first_pose(scan, route), "reached", 0
    with scene.session(AVATAR) as session:

        def step(number: int, command: Command, **fields: Any) -> Floats:
            commands.append(command)
            legs.append(number)
            states.append(session.wait(session.wish(time=len(states) * FRAME, **fields)))
            return states[-1].pose[0]

        rest = Command(np.zeros(3), 0.0)
        for frame in range(_SETTLE_FRAMES):
            first = {"pose": pose} if frame == 0 else {"velocity": (0.0, 0.0, 0.0)}
            pose = step(0, rest, **first)
        for number, leg in enumerate(route.legs):
            command, far = command_towards(pose, leg, scan, route.speed)
            limit = int(_PATIENCE * far / (route.speed * FRAME)) + _EXTRA_FRAMES
            places = [pose[:3, 3]]
            while far > REACH and why == "reached":
                pose = step(number, command, velocity=tuple(command.velocity.tolist()), turn=command.turn)
                places.append(pose[:3, 3])
                if len(places) > limit:
                    why = "slow"
                if len(places) > _STILL_FRAMES and np.ptp(places[-_STILL_FRAMES:], axis=0).max() < _STILL:
                    why = "stuck"
                command, far = command_towards(pose, leg, scan, route.speed)
            if why != "reached":
                break
            reached += 1
    poses = np.concatenate([state.pose for state in states])
    return Walked(commands, poses, states, np.array(legs), reached, why)


def record_walk(scene: Scene, scan: Scan, route: Route, person: Person, file: Path, log: Path) -> Walked:
    """Walk a route and record it to a new log. file: the scene file."""
    with recorded(scene, file, log):
        return walk_route(scene, scan, route, person)


def replay_walk(file: Path, log: Path) -> dict[str, Any]:
    """Replay a log in a newly opened scene, as `solidcloud replay` does; return what it found."""
    head, frames = read_log(log)
    with Scene.open(file, head.scene) as scene:
        assert check_same(head, scene.simulation, file)
        return asdict(replay(scene.simulation, frames))
