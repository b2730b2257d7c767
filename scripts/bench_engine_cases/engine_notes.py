"""Notes on missed targets and on the reading of figures, shown beside them, by the target's key."""

NOTES: dict[str, str] = {
    "distance collide": (
        "`collide` ends at the first slab between; `distance` has to find the nearest of some hundred points of the "
        "soles that are within a millimetre of the least height. Tried: a greedy first pair (20.7 µs: ten times too "
        "far), a widening bound (9.7), points against exact boxes, a list settled in integers at the end, inlining "
        "(7.9); no gain: a cylinder bound, children in order, transposed pair tests. In microseconds it is under the "
        "20 that 2 x meant when a pose was expected to take 10"
    ),
}
