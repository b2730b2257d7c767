"""Effects of a scene. Only the effects that a scene declares are imported (NUMERICS.md case 31).

Each effect is one file, named as in the scene file, whose `make(effect, world)` returns a `Runner`.
The code that effects share is in simulation/world/. effect_pipeline.py runs the effects that a
scene declares, in this order:

1. `objects`, `crowd`: place everything else that could be met, before anyone moves.
2. `stop`, with `sweep`: follow the motion command as far as nothing is touched.
3. `slide`: continue the remaining motion along what was touched.
4. `step`: carry the motion that is left after that over low obstacles.
5. `ground`: as the last motion, let the feet settle or fall where the avatar arrived.
6. `proximity`, `contacts`, `uncertainty`: report about the final pose. The most expensive comes
   last, because the last is skipped first.

`through` has no part in a frame: it changes the scene once, when it is opened.

May import server.archives, server.avatars, server.queries, server.queries.context,
server.residency, server.runtime, server.simulation.world, schemas.
Begin with effect_pipeline.py, then stop_effect.py.
"""
