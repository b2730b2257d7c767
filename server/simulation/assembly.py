"""Assembly of a simulation: the collision world, and the effects that a scene file declares and no others."""

from functools import partial
from typing import Any

import numpy as np

from ...schemas.scene.scene_file import SceneFile
from ..archives.rigid_transform import moved
from ..queries.within import within
from .simulation import Simulation, Stage


def simulate(scene: Stage, file: SceneFile) -> Simulation:
    """Return the simulation of a scene's frames, as its file declares effects."""
    # Imported here: whoever only asks questions has no use for effects and their kernels.
    from .effects.pipeline import make_pipeline
    from .world.collision_world import World

    world = World(scene, file)
    pipeline = make_pipeline(file, world)
    return Simulation(scene, file, pipeline, pipeline.bodies, partial(_scan_point, world))


def _scan_point(world: Any) -> Any:
    """Return some scan point of a world, (3,) [m]; its archive's least corner if none is found."""
    with world as seen:
        archive, data, pose = seen[0].opened.store.archive, seen[0].data, seen[0].placed.pose
        lattice = archive.header.lattice
        corner = archive.coordinates[0] * lattice.voxel_steps + archive.voxels["low"][0]
        place = lattice.to_world(corner[None])
        found = within(data, place, min(16.0, 2 * lattice.voxel_size)).cloud_point
        place = found if np.isfinite(found).all() else place
        return (place if pose is None else moved(pose, place))[0]
