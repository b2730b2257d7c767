"""How a scene gets its frames: the world and the effects that its file declares, and no others, are imported here.

`Simulated` gives them to a `Scene`, an archive without a file: it and `stop`.
"""

import threading
from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np

from ...schemas.scene.scene_file import SceneFile, scene_of
from ...schemas.wire.moves import FRAME_SECONDS, Moved
from ..archives.rigid_transform import moved
from ..queries.within import within
from ..runtime.stop_flag import NEVER, Stop
from ..served.avatar_limits import EVERYBODY
from .simulation import Simulation, Stage

_MAKING = threading.Lock()


def simulate(
    served: Stage, file: SceneFile, avatars: Mapping[str, tuple[Any, float | None]] | None = None
) -> Simulation:
    """The simulation of what is served, as its file says.

    avatars: the scene's own, points (n, 3) [m] and radius by name; None: of half the mean closest-point distance.
    """
    # Here, and not above: whoever only asks questions has no use for effects and their kernels.
    from .effects.pipeline import make_pipeline
    from .world.collision_world import World

    own = [
        served.add_avatar(name, points, radius, client=EVERYBODY)
        for name, (points, radius) in (avatars or {}).items()
    ]
    world = World(served, file)
    pipeline = make_pipeline(file, world)
    return Simulation(served, file, pipeline, own, pipeline.bodies, partial(_scan_point, world))


def _scan_point(world: Any) -> Any:
    """Some scan point of a world, (3,) [m]; its archive's least corner where none is found."""
    with world as seen:
        archive, data, pose = seen[0].opened.store.archive, seen[0].data, seen[0].placed.pose
        lattice = archive.header.lattice
        corner = archive.coordinates[0] * lattice.voxel_steps + archive.voxels["low"][0]
        place = lattice.to_world(corner[None])
        found = within(data, place, min(16.0, 2 * lattice.voxel_size)).cloud_point
        place = found if np.isfinite(found).all() else place
        return (place if pose is None else moved(pose, place))[0]


class Simulated:
    """What a scene without a file moves users by; made at its first use."""

    name: str
    _simulation: Simulation | None = None

    @property
    def simulation(self: Any) -> Simulation:
        """What simulates frames of this scene."""
        with _MAKING:
            if self._simulation is None:
                self._simulation = simulate(self, scene_of(self.name))
            made: Simulation = self._simulation
        return made

    def move(
        self,
        name: str,
        pose_from: Any,
        pose_to: Any,
        seconds: float = FRAME_SECONDS,
        *,
        client: str = "",
        stop: Stop = NEVER,
    ) -> Moved:
        """Where avatar `name` gets from one pose (1, 4, 4) towards another in a frame; nothing is remembered.

        What it touches stops it. See `Simulation.move`.
        """
        return self.simulation.move(name, pose_from, pose_to, seconds, client=client, stop=stop)
