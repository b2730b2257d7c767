"""Record of a body after a frame that lacked voxels and did not wait for them.

Such a frame depends on what was in memory, which no replay can repeat. The log therefore holds what
later frames depend on, and a replay takes it from there.
"""

from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from ...schemas.wire.answers import Verdict
from ...schemas.wire.motion_messages import Moved
from ..runtime.stop_flag import NO_STOP
from .world.frame import Body, Pose

if TYPE_CHECKING:  # only scenes whose users can collide import it
    from .world.bodies import Bodies

# Name under which the effect `ground` keeps the plane that the avatar stands on.
_GROUND = "ground"
# Name under which it keeps the place where the avatar was raised last.
_RAISED = "ground raised"


class BodyRecord(msgspec.Struct, frozen=True, array_like=True):
    """State of a body between frames, as in `Body`, and of the objects that users push.

    pose: as in `TurnResult`.  ground: point and normal of the plane that it stands on, 6 float64,
    little-endian; b"" for none.  pushed: poses of the objects that users push, by name.
    raised: place where `ground` raised it last, 3 float64, little-endian; b"" for none.
    """

    pose: bytes
    fall_speed: float
    on_ground: bool
    clear: bool
    ground: bytes = b""
    pushed: dict[str, bytes] = {}
    raised: bytes = b""


def pose_bytes(pose: Any) -> bytes:
    """Return the logged form of a pose (4, 4): its float64 bytes, little-endian."""
    return np.ascontiguousarray(pose, "<f8").tobytes()


def _pose(data: bytes) -> Pose:
    """Return the pose (4, 4) of its logged form."""
    return np.frombuffer(data, "<f8").reshape(4, 4).astype(np.float64)


def record_of(body: Body, bodies: "Bodies | None") -> BodyRecord:
    """Return the record of a body. bodies: of the scene; None if users cannot collide."""
    stood, raised = body.effect_state.get(_GROUND), body.effect_state.get(_RAISED)
    pushed = {}
    if bodies is not None:
        from .world.bodies import PUSHED

        for row in np.flatnonzero(bodies.kinds == PUSHED).tolist():
            pushed[bodies.names[row]] = pose_bytes(bodies.poses[row])
    return BodyRecord(
        pose_bytes(body.pose),
        body.fall_speed,
        body.on_ground,
        body.clear,
        b"" if stood is None else stood.astype("<f8").tobytes(),
        pushed,
        b"" if raised is None else raised.astype("<f8").tobytes(),
    )


def take_record(record: BodyRecord, body: Body, world: Any, bodies: "Bodies | None") -> Moved:
    """Set a body, and the objects that users push, to a record; return the frame's result.

    The verdict is CONTACT if the record states that the pose is clear and it touches the scan.
    """
    world.begin(NO_STOP)
    body.pose, body.generations = _pose(record.pose), world.generations()
    body.fall_speed, body.on_ground, body.clear = record.fall_speed, record.on_ground, record.clear
    body.effect_state.pop(_GROUND, None)
    if record.ground:
        body.effect_state[_GROUND] = np.frombuffer(record.ground, "<f8").astype(np.float64)
    body.effect_state.pop(_RAISED, None)
    if record.raised:
        body.effect_state[_RAISED] = np.frombuffer(record.raised, "<f8").astype(np.float64)
    if bodies is not None:
        bodies.begin()
        for name, pose in record.pushed.items():
            row = bodies.row_of(name, user=False)
            if row >= 0:
                bodies.put(row, _pose(pose))
    verdict = world.collide(body.avatar, body.pose) if record.clear else Verdict.UNKNOWN
    return Moved(pose=body.pose[None].copy(), verdict=int(verdict), unknown=True)
