"""Effects of a scene. Only the files of those that a scene declares are imported (NUMERICS.md case 31).

The function `make(effect, world)` of an effect's file returns the function that runs the effect for a
frame and returns its report, if it has one. The code that effects share is in simulation/world/. The
pipeline in simulation.py runs the effects that a scene declares, in this order:

1. `objects`, `crowd`: add objects and other users as obstacles, before the avatar moves.
2. `stop`, with `sweep`: follow the motion command until the first contact.
3. `slide`: continue the remaining motion along the touched surfaces.
4. `step`: try to climb low obstacles with the motion that still remains.
5. `ground`: as the last motion, lower the avatar to the ground, or let it fall.
6. `proximity`, `contacts`, `uncertainty`: report about the final pose.

`through` does nothing in a frame: archives/masked_store.py leaves its points out of the scene.

May import server.archives, server.avatars, server.queries, server.simulation.world, schemas.
Begin with motion_effects.py.
"""
