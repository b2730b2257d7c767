"""Heap of node pairs by lower bound, then by upper bound; see `BestFirstSearch`."""

from ..core.kernel_decorators import njit_no_refcount


@njit_no_refcount
def sift_up(keys, pairs, at):
    """Move the pair at the end of a heap up to its place."""
    key, tie, a, row, voxel = keys[at, 0], keys[at, 1], pairs[at, 0], pairs[at, 1], pairs[at, 2]
    while at > 0:
        parent = (at - 1) // 2
        if keys[parent, 0] < key or (keys[parent, 0] == key and keys[parent, 1] <= tie):
            break
        keys[at, 0], keys[at, 1] = keys[parent, 0], keys[parent, 1]
        pairs[at, 0], pairs[at, 1], pairs[at, 2] = pairs[parent, 0], pairs[parent, 1], pairs[parent, 2]
        at = parent
    keys[at, 0], keys[at, 1], pairs[at, 0], pairs[at, 1], pairs[at, 2] = key, tie, a, row, voxel


@njit_no_refcount
def pop_top(keys, pairs, size):
    """Remove the top of a heap of `size` pairs."""
    last = size - 1
    key, tie, a, row, voxel = keys[last, 0], keys[last, 1], pairs[last, 0], pairs[last, 1], pairs[last, 2]
    at = 0
    while 2 * at + 1 < last:
        child = 2 * at + 1
        right = child + 1
        if right < last and (
            keys[right, 0] < keys[child, 0]
            or (keys[right, 0] == keys[child, 0] and keys[right, 1] < keys[child, 1])
        ):
            child = right
        if key < keys[child, 0] or (key == keys[child, 0] and tie <= keys[child, 1]):
            break
        keys[at, 0], keys[at, 1] = keys[child, 0], keys[child, 1]
        pairs[at, 0], pairs[at, 1], pairs[at, 2] = pairs[child, 0], pairs[child, 1], pairs[child, 2]
        at = child
    keys[at, 0], keys[at, 1], pairs[at, 0], pairs[at, 1], pairs[at, 2] = key, tie, a, row, voxel
