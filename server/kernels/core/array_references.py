"""References to the arrays of a scene and of an avatar, for kernels that are called once a pose.

numba takes every array of a tuple apart at each call from Python. A scene and an avatar have twenty,
which takes longer than most searches (scripts/bench_walk). A reference is one object in Python that
holds them for compiled code: it is taken apart once, when it is made.
"""

import hashlib
import sys
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from ....schemas.runtime import compiling as nb
from .placed_avatar import Avatar
from .reach import OneReach, VoxelTree, make_one_reach
from .scene_arrays import SceneArrays

_Fields = TypeVar("_Fields", bound=type)


def reference(fields: _Fields) -> _Fields:
    """Turn a named tuple into references with its fields, at the top of a module.

    Kernels read the fields by name. Only compiled code makes a reference.
    """
    if nb.config.DISABLE_JIT:
        return fields
    name, module = fields.__name__, fields.__module__

    def name_shortly(self: Any, types: Any) -> None:
        """Replace numba's name of a type, which lists all fields: it is part of each function's name."""
        nb.types.StructRef.__init__(self, types)
        self.name = f"{name}-{hashlib.sha256(self.name.encode()).hexdigest()}"

    # Stored kernels name numba's type by module and name.
    made = {"__module__": module, "__init__": name_shortly}
    numba_type = type(f"_{name}Type", (nb.types.StructRef,), made)
    setattr(sys.modules[module], numba_type.__name__, nb.structref.register(numba_type))
    found: Any = type(name, (nb.structref.StructRefProxy,), {"__module__": module, "__doc__": fields.__doc__})
    nb.structref.define_proxy(found, numba_type, list(fields._fields))  # type: ignore[attr-defined]
    return found  # type: ignore[no-any-return]


@reference
class SceneReference(NamedTuple):
    """Arrays of a scene, the boxes of its voxels, and scratch of a query of one pose or point."""

    scene: SceneArrays
    tree: VoxelTree
    one: OneReach


@reference
class AvatarReference(NamedTuple):
    """Arrays of an avatar, see `refer_to_avatar`."""

    avatar: Avatar
    rows: NDArray[np.int32]
    surface: int
    points: NDArray[np.float64]
    radius: float
    box: NDArray[np.float64]


@nb.njit(nogil=True, cache=True)
def refer_to_scene(scene, tree, one):
    """Return a reference to the arrays of a scene, the boxes of its voxels, and scratch."""
    return SceneReference(scene, tree, one)


@nb.njit(nogil=True, cache=True)
def refer_to_avatar(avatar, rows, surface, points, radius, box):
    """Return a reference to the arrays of an avatar.

    rows: (b, LANES) int32, number of the point in each lane of a block.  surface: number of the points
    of its surface; those after them are inside.  points: (n, 3), avatar frame [m].  radius: of its
    spheres [m].  box: (2, 3) around its points; zeros if it has none.
    """
    return AvatarReference(avatar, rows, surface, points, radius, box)


@nb.njit(nogil=True, cache=True)
def with_flag(scene, stop):
    """Return the arrays of a scene with the stop flag of a request, (1,) int64."""
    return SceneArrays(
        scene.words, scene.ints, scene.halves, scene.where, scene.corners, scene.origin, scene.step,
        scene.units_per_step, scene.voxel_steps, scene.block_words, scene.radius_deficit, stop,
    )  # fmt: skip


def record_type(*fields: tuple[Any, ...]) -> np.dtype[Any]:
    """Return the type of records whose fields kernels read by name. fields: as of a structured dtype."""
    found = np.dtype(list(fields), align=True)
    return np.dtype((np.record, found)) if nb.config.DISABLE_JIT else found


class Held:
    """Reference to arrays, and the code of the kernels that take it.

    reference: as the kernels take it.
    """

    __slots__ = ("_code", "reference")

    def __init__(self, reference: Any) -> None:
        self.reference = reference
        self._code: dict[Any, Any] = {}

    def call(self, kernel: Any, *arguments: Any) -> Any:
        """Call a kernel with arguments whose types, and memory orders of arrays, are always the same."""
        code = self._code.get(kernel)
        if code is None:
            code = self._code[kernel] = nb.entry_point(kernel, *arguments)
        return code(*arguments)


class SceneReferences:
    """The last reference made for a scene's data, whose arrays never change but for the stop flag.

    Thread-safe. Its scratch may be used only while the scene's residency is locked.
    """

    __slots__ = ("_known",)

    def __init__(self) -> None:
        self._known: tuple[SceneArrays, VoxelTree, HeldScene] | None = None

    def to(self, scene: SceneArrays, tree: VoxelTree) -> "HeldScene":
        """Return a reference to these arrays; its stop flag is that of an earlier request."""
        if self._known is not None:
            known, known_tree, held = self._known
            if (
                known.words is scene.words
                and known.where is scene.where
                and known.origin is scene.origin
                and known.radius_deficit is scene.radius_deficit
                and known_tree is tree
            ):
                return held
        held = HeldScene(scene, tree)
        self._known = scene, tree, held
        return held


class HeldScene(Held):
    """Reference to the arrays of a scene. rows: voxels in reach of the last pose or point."""

    __slots__ = ("outside", "rows")

    def __init__(self, scene: SceneArrays, tree: VoxelTree) -> None:
        one = make_one_reach()
        self.rows, self.outside = one.reach.lists.rows, one.reach.outside
        super().__init__(refer_to_scene(scene, tree, one))
