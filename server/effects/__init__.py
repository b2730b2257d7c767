"""Effects: what a scene calls for is simulated, nothing else is imported (NUMERICS.md case 31).

One file each, named as in the scene file; `make(effect, world)` of it returns a `Runner`. pipeline.py composes those
that a scene declares, in this order:

1. `objects`, `crowd`: what else could be met is placed before anybody goes.
2. `stop`, with `sweep`: the wish is gone along as far as nothing is touched.
3. `slide`: what is left of it goes along what was touched.
4. `step`: what is left after that may go over what is low.
5. `ground`: last of what moves: feet come down, or fall, where the avatar got to.
6. `proximity`, `contacts`, `uncertainty`: say something of where the avatar is in the end; what costs most comes last,
   for what comes last is skipped first.

`through` is none of a frame: it changes what the scene is, once, when it is opened.
"""
