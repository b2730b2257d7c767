"""What was tried where a goal is not reached, or how its figure is to be read: shown beside it, by the goal's key."""

NOTES: dict[str, str] = {
    "session": (
        "the goal was set when a stateless pose was expected to take 10 µs: of that, the memory takes 0.3 at 30 "
        "frames/s and 0.15 at 90. Standing still costs 0.5 µs, half of it checking the request and holding its voxels; "
        "at 30 frames/s the feet move 5 cm, 8 mm from contact, and about eight entries a pose are looked at again, "
        "0.1 µs each. Tried: a front of the avatar with a way left for each node and slabs near it (8 to 10 µs); "
        "entries of the scene with a way and a gap (4.2), vectorised (3.5), scene points against the avatar's boxes at "
        "leaf nodes (2.65), gaps kept apart from ways (2.5). At 1,000 frames/s it is 0.22 x"
    ),
    "session stretch": "met at 90 frames/s; at 30 see above",
    "distance collide": (
        "`collide` ends at the first slab between; `distance` has to find the nearest of some hundred points of the "
        "soles that are within a millimetre of the least height. Tried: a greedy first pair (20.7 µs: ten times too "
        "far), a widening bound (9.7), points against exact boxes, a list settled in integers at the end, inlining "
        "(7.9); no gain: a cylinder bound, children in order, transposed pair tests. In microseconds it is under the "
        "20 that 2 x meant when a pose was expected to take 10"
    ),
}
