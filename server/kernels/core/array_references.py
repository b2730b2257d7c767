"""References to the arrays of a scene and of an avatar, for kernels that are called once a pose.

numba takes every array of a tuple apart at each call from Python. A scene and an avatar have twenty,
which takes longer than most searches (scripts/bench_walk). A reference is one object in Python that
holds them for compiled code: it is taken apart once, when it is made.
"""

from typing import Any, NamedTuple

from ....schemas.kernels import compiling as nb
from .placed_avatar import Avatar
from .scene_arrays import SceneArrays
from .voxels_in_reach import SceneIndex

if nb.config.DISABLE_JIT:

    class SceneReference(NamedTuple):
        """Arrays and index of a scene."""

        scene: SceneArrays
        index: SceneIndex  # type: ignore[assignment]  # hides tuple.index, which nobody calls

    class AvatarReference(NamedTuple):
        """Arrays of an avatar."""

        avatar: Avatar

else:

    @nb.structref.register
    class _SceneReferenceType(nb.types.StructRef):  # type: ignore[misc]
        """numba's type of a `SceneReference`."""

    @nb.structref.register
    class _AvatarReferenceType(nb.types.StructRef):  # type: ignore[misc]
        """numba's type of an `AvatarReference`."""

    class SceneReference(nb.structref.StructRefProxy):  # type: ignore[misc,no-redef]
        """Arrays and index of a scene."""

    class AvatarReference(nb.structref.StructRefProxy):  # type: ignore[misc,no-redef]
        """Arrays of an avatar."""

    nb.structref.define_proxy(SceneReference, _SceneReferenceType, ["scene", "index"])
    nb.structref.define_proxy(AvatarReference, _AvatarReferenceType, ["avatar"])


@nb.njit(nogil=True, cache=True)
def refer_to_scene(scene, index):
    """Return a reference to the arrays and the index of a scene."""
    return SceneReference(scene, index)


@nb.njit(nogil=True, cache=True)
def refer_to_avatar(avatar):
    """Return a reference to the arrays of an avatar."""
    return AvatarReference(avatar)


@nb.njit(nogil=True, cache=True)
def with_flag(scene, stop):
    """Return the arrays of a scene with the stop flag of a request, (1,) int64."""
    return SceneArrays(
        scene.words, scene.ints, scene.halves, scene.where, scene.coordinates, scene.origin, scene.step,
        scene.units_per_step, scene.voxel_steps, scene.block_words, scene.radius_deficit, stop,
    )  # fmt: skip


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

    Thread-safe.
    """

    __slots__ = ("_known",)

    def __init__(self) -> None:
        self._known: tuple[SceneArrays, SceneIndex, Held] | None = None

    def to(self, scene: SceneArrays, index: SceneIndex) -> Held:
        """Return a reference to these arrays; its stop flag is that of an earlier request."""
        if self._known is not None:
            known, known_index, held = self._known
            if (
                known.words is scene.words
                and known.where is scene.where
                and known.origin is scene.origin
                and known.radius_deficit is scene.radius_deficit
                and known_index is index
            ):
                return held
        held = Held(refer_to_scene(scene, index))
        self._known = scene, index, held
        return held
