"""Construction of a scene's simulation from its collision world and the effects of its file."""

from functools import partial
from typing import Any

import numpy as np

from ...schemas.scene.scene_file import SceneFile
from ..archives.rigid_transform import transform_points
from ..queries.within import within
from .simulation import SimulatedScene, Simulation


def make_simulation(scene: SimulatedScene, file: SceneFile) -> Simulation:
    """Return the simulation of a scene's frames, with the effects that `file` declares."""
    # Imported here, because a scene that is only queried needs neither effects nor their kernels.
    from .effects.effect_pipeline import make_pipeline
    from .world.collision_world import World

    world = World(scene, file)
    pipeline = make_pipeline(file, world)
    return Simulation(scene, file, pipeline, pipeline.bodies, partial(_find_scan_point, world))


def _find_scan_point(world: Any) -> Any:
    """Return some scan point of a world, (3,) [m]; its archive's least corner if none is found."""
    with world as held:
        archive, data, pose = held[0].opened.store.archive, held[0].data, held[0].placed.pose
        lattice = archive.header.lattice
        corner = archive.coordinates[0] * lattice.voxel_steps + archive.voxels["low"][0]
        place = lattice.to_world(corner[None])
        found = within(data, place, min(16.0, 2 * lattice.voxel_size)).cloud_point
        place = found if np.isfinite(found).all() else place
        return (place if pose is None else transform_points(pose, place))[0]
