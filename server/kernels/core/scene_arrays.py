"""Arrays of a scene that the kernels read: the layout of a voxel in the arena, and the stop flag.

The arena is one buffer with three views: float32 words, int32 words and uint16 halfwords. A voxel
takes three runs. It takes a fourth run where the archive keeps scan numbers (`--keep scan`):

- rows: (n, 12) words, one row a node: center x, y, z, radius [voxel steps], the slab's normal x, y,
  z, its length, least and greatest dot(normal, point - center), or a box in their place
  (node_bounds.py); then two int32: the first child row, or ~block for a leaf node; a word whose low
  byte is the number of children or points and whose next byte is the node's radius class. 48 bytes,
  four rows to three cache lines;
- blocks: (b, 4) int32, one block a leaf node: low corner x, y, z of the box of its points [voxel
  steps], number of points. (b, 12) where the archive keeps radius classes: the classes of the
  block's points follow, four to an int32, the first in its low byte;
- lanes: (b, 3, LANES) halfwords: x[], y[], z[] of the block's points, relative to that corner. The
  last point is repeated to the end, which lets a test of all lanes work without a mask;
- scans: (b, LANES) halfwords, the scan each point came from (`scan_run`); absent where the archive
  does not keep it;

For the façade this is 8.7 bytes a point, 6 of them the points (scripts/bench_engine --only memory).
Scans take 2 more and radius classes 1.1 more, where kept.

The radius class of a node (schemas/archive/radius_model.py) is the largest local class of the
points below it, with RIM_BIT where all of them have it. It is the class of the largest sphere below
the node under every radius model.

Another thread sets a request's stop flag (server/runtime/stop_flag.py) while a kernel runs. The
compiler may move an ordinary load out of a loop, but not an atomic one. An atomic load costs the
same as an ordinary load.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....schemas.archive.radius_model import LOCAL_CLASSES, RIM_BIT
from ....schemas.archive.voxel import MAX_LEAF
from ....schemas.runtime import compiling as nb
from .kernel_decorators import njit_no_refcount

# 32 uint16 lanes become 32 float32 in one vector loop. LLVM unrolls loops of 8 or 16 constant
# iterations and then does not vectorise them, which costs several times as much a pair.
LANES = MAX_LEAF
ROW_WORDS = 12
BLOCK_WORDS = 4
# Index in a block of the first word of radius classes, where they are kept: four classes to a word.
CLASSES = BLOCK_WORDS
CLASSED_BLOCK_WORDS = BLOCK_WORDS + LANES // 4
FIRST, COUNT = 10, 11  # columns of a row that hold int32
# A row's COUNT: the low byte is the number of children or points. From these bits on, the radius
# class of the node, five bits, and that of the largest sphere in its block or below it.
COUNTED = 0xFF
CLASS_SHIFT = 8
LEAF_CLASS_SHIFT = 13
LOCAL_MASK = LOCAL_CLASSES - 1


class Arena(NamedTuple):
    """One buffer, three views: words (float32), ints (int32), halves (uint16)."""

    words: NDArray[np.float32]
    ints: NDArray[np.int32]
    halves: NDArray[np.uint16]


class SceneArrays(NamedTuple):
    """Arrays of a scene that the kernels read.

    words, ints, halves: the arena.
    where: (v, 3) int64, the starts of a voxel's rows, blocks and lanes in the arena; -1: not
    resident.
    corners: (v, 3) int64, the low corner of each voxel [steps].  voxel_steps: edge of the largest voxel.
    origin: (3,) float64 [m].  step: [m].
    block_words: words of a block, with or without radius classes.
    radius_deficit: (1,) or (RADIUS_CLASSES,) int64, the largest radius minus the radius of each
    class, exact units; one element where all spheres have the same radius.
    stop: (1,) int64, the request's stop flag.
    """

    words: NDArray[np.float32]
    ints: NDArray[np.int32]
    halves: NDArray[np.uint16]
    where: NDArray[np.int64]
    corners: NDArray[np.int64]
    origin: NDArray[np.float64]
    step: float
    units_per_step: float
    voxel_steps: int
    block_words: int
    radius_deficit: NDArray[np.int64]
    stop: NDArray[np.int64]


def block_words(radius_class: bool) -> int:
    """Return the number of words of a block in an archive with or without radius classes."""
    return CLASSED_BLOCK_WORDS if radius_class else BLOCK_WORDS


def resident_bytes(
    nodes: NDArray[np.int64],
    leaves: NDArray[np.int64],
    *,
    with_scan: bool = False,
    with_class: bool = False,
) -> NDArray[np.int64]:
    """Return the bytes (v,) that voxels take in the arena, multiples of 16.

    nodes, leaves: the number of nodes of each voxel, and how many of them are leaf nodes.
    with_scan, with_class: whether scan numbers and radius classes are kept.
    """
    halves = LANES * (3 + with_scan)
    return 4 * ROW_WORDS * nodes + 4 * block_words(with_class) * leaves + 2 * halves * leaves


@nb.njit(nogil=True, cache=True)
def scan_run(where, voxel, block_words):
    """Return the offset of a resident voxel's scans [halves], in an archive that keeps them.

    They follow its lanes, LANES a block.
    """
    leaves = (where[voxel, 2] // 2 - where[voxel, 1]) // block_words
    return where[voxel, 2] + leaves * 3 * LANES


@njit_no_refcount
def node_class(ints, row, mask):
    """Return a scene node's index into `radius_deficit`. mask: the number of classes minus one."""
    return np.uint64(ints[np.uint64(row + COUNT)] >> CLASS_SHIFT) & mask


@njit_no_refcount
def leaf_class(ints, row, mask):
    """Return the index into `radius_deficit` of the largest sphere in a leaf node's block.

    It is the node's class, except in a level of detail. mask: as for `node_class`.
    """
    return np.uint64(ints[np.uint64(row + COUNT)] >> LEAF_CLASS_SHIFT) & mask


@njit_no_refcount
def point_class(ints, block_at, lane, mask):
    """Return the index into `radius_deficit` of a point of the block at `block_at`.

    mask: the number of classes minus one. Where blocks hold no classes, this reads whatever follows
    the block in the arena, and the mask of 0 discards it.
    """
    word = ints[np.uint64(block_at + CLASSES + lane // 4)]
    return np.uint64(word >> (8 * (lane % 4))) & mask


@nb.njit(nogil=True, cache=True)
def _outward(value, up):
    """Round an int32 to float32, never down if `up`, else never up: a bound stays a bound."""
    narrow = np.float32(value)
    if abs(value) <= 1 << 24:  # exact
        return narrow
    if up and np.float64(narrow) < np.float64(value):
        return np.nextafter(narrow, np.float32(np.inf))
    if not up and np.float64(narrow) > np.float64(value):
        return np.nextafter(narrow, np.float32(-np.inf))
    return narrow


@nb.njit(nogil=True, cache=True)
def lay_out(voxel, links, arena, at_bytes, block_words, where):
    """Write the rows and blocks of a checked voxel into the arena, from byte `at_bytes` on.

    at_bytes: a multiple of 16.
    voxel: (cells, nodes, top_shift) of schemas/archive/codec.py `DecompressedRecord`; center is
    therefore (3, n).
    links: its Links without the height.
    Writes where (3,) int64: first row [words], first block [ints], first lane [halves]. The points
    belong at the first lane (schemas/archive/codec.py, `DecompressedRecord.read_points`).
    """
    cells, nodes, top_shift = voxel
    first, is_leaf, cell_of = links
    words, ints, _ = arena
    n = first.shape[0]
    # Unsigned: see schemas/kernels/record_rows.py.
    row = np.uint64(at_bytes // 4)
    block_at = row + np.uint64(n * ROW_WORDS)
    where[0], where[1] = row, block_at
    block = np.int32(0)
    for i in range(np.uint64(n)):
        top = cell_of[i] < 0
        cell = np.uint64(0) if top else np.uint64(cell_of[i])
        unit = np.int32(1) << np.int32(top_shift) if top else np.int32(1)
        square = np.int32(0)
        for k in range(np.uint64(3)):
            # Integers below 2^24: a voxel has at most 2^21 steps, a cell 2^16.
            low = np.int32(0) if top else cells.low[k, cell]
            words[row + k] = np.float32(low + np.int32(nodes.center[k, i]) * unit)
            component = np.int32(nodes.normal[k, i])
            words[row + np.uint64(4) + k] = np.float32(component)
            square += component * component
        words[row + np.uint64(3)] = np.float32(np.int32(nodes.radius[i]) * unit)
        # The next float32 up, as np.nextafter returns it for a non-negative number; calling that
        # costs 5 ns.
        length = np.float32(np.sqrt(np.float64(square)))
        ints[row + np.uint64(7)] = length.view(np.int32) + np.int32(1)
        # A node whose normal is zero has no slab. The numbers a record holds there must not exclude
        # points.
        least = nodes.slab[np.uint64(0), i] if square > 0 else np.int32(0)
        most = nodes.slab[np.uint64(1), i] if square > 0 else np.int32(0)
        words[row + np.uint64(8)] = _outward(least, False)
        words[row + np.uint64(9)] = _outward(most, True)
        ints[row + np.uint64(FIRST)] = ~block if is_leaf[i] else first[i]
        ints[row + np.uint64(COUNT)] = np.int32(nodes.count[i])
        row += np.uint64(ROW_WORDS)
        if is_leaf[i]:
            for k in range(np.uint64(3)):
                ints[block_at + k] = cells.low[k, cell] + np.int32(nodes.block_low[k, i])
            ints[block_at + np.uint64(3)] = np.int32(nodes.count[i])
            block_at += np.uint64(block_words)
            block += np.int32(1)
    where[2] = np.uint64(2) * block_at


@nb.njit(nogil=True, cache=True)
def lay_classes(links, classes, ints, where):
    """Write the radius classes of a voxel that `lay_out` wrote: of its points, then of its nodes.

    links: as for `lay_out`.  classes: (b, LANES) uint8, from `DecompressedRecord.read_classes`, in
    the order of the blocks.  where: (3,) int64, see `lay_out`.
    """
    first, is_leaf, _ = links
    block = classes.shape[0]
    for node in range(first.shape[0] - 1, -1, -1):  # children follow their parents
        row = where[0] + node * ROW_WORDS
        largest, all_rim = np.int64(0), np.int64(RIM_BIT)
        if is_leaf[node]:
            block -= 1
            at = where[1] + block * CLASSED_BLOCK_WORDS + CLASSES
            for word in range(LANES // 4):
                packed = np.int64(0)
                for k in range(4):
                    packed |= np.int64(classes[block, 4 * word + k]) << (8 * k)
                ints[at + word] = packed
            for lane in range(LANES):  # lanes after the last point repeat it and change nothing
                own = np.int64(classes[block, lane])
                largest, all_rim = np.int64(max(largest, own & LOCAL_MASK)), all_rim & own
        else:
            for child in range(first[node], first[node] + (ints[row + COUNT] & COUNTED)):
                own = np.int64(ints[where[0] + child * ROW_WORDS + COUNT]) >> LEAF_CLASS_SHIFT
                largest, all_rim = np.int64(max(largest, own & LOCAL_MASK)), all_rim & own
        own = largest | all_rim
        ints[row + COUNT] = (ints[row + COUNT] & COUNTED) | (own << CLASS_SHIFT) | (own << LEAF_CLASS_SHIFT)


def lay_node_class(nodes: int, own: int, ints: NDArray[np.int32], where: NDArray[np.int64]) -> None:
    """Replace the radius class of all nodes of a voxel, `nodes` of them, by `own`.

    The classes of leaf nodes' blocks stay.
    """
    counts = ints[where[0] :][: nodes * ROW_WORDS].reshape(nodes, ROW_WORDS)[:, COUNT]
    of_block = counts >> LEAF_CLASS_SHIFT << LEAF_CLASS_SHIFT
    counts[:] = of_block | (own << CLASS_SHIFT) | (counts & COUNTED)


@nb.intrinsic
def _stopped(context, flag):  # type: ignore[no-untyped-def]
    """Load the first element of an array (1,) int64 atomically; return whether it is set."""

    def generate(context, builder, signature, arguments):  # type: ignore[no-untyped-def]
        array = context.make_array(signature.args[0])(context, builder, arguments[0])
        loaded = builder.load_atomic(array.data, "monotonic", 8)
        return builder.icmp_signed("!=", loaded, loaded.type(0))

    return nb.types.boolean(flag), generate


def _stopped_interpreted(flag):  # type: ignore[no-untyped-def]
    return flag[0] != 0


# stopped(flag): return whether the flag (1,) int64 is set. Intrinsics cannot be interpreted.
stopped: Any = _stopped_interpreted if nb.config.DISABLE_JIT else _stopped
