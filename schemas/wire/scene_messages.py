"""Messages about scenes: scenes of a server, description of a scene, avatars, reload and errors."""

from typing import Annotated

import msgspec

from ..errors import ErrorCode

WIRE_VERSION = 1


class ScenesAnswer(msgspec.Struct, frozen=True):
    """Scenes that one server serves."""

    scenes: list[str]
    wire_version: int = WIRE_VERSION
    format_version: int = 0


class AvatarInfo(msgspec.Struct, frozen=True):
    """Avatar as the server stores it.

    points: number of points.  radius: of every point [m].
    bounding_radius: radius of a sphere around the avatar's points and their radii [m].
    inner_points: number of points that fill the inside of a mesh, the last ones.
    description: what was taken of the avatar's file or mesh, and how: whether it is filled or only
    a surface, the file's up axis and unit. The process that reads the file fills it in: a server
    for the scene's own avatars, `add_avatar` for others; empty for points.
    If no server has answered yet, `Client` returns a `bounding_radius` of null, and the `radius`
    that was requested.
    """

    name: str
    points: int
    radius: float | None = None
    bounding_radius: float | None = None
    inner_points: int = 0
    description: str = ""


class SourceInfo(msgspec.Struct, frozen=True):
    """One scan that was built into the archive.

    index: index of the scan inside its file.  sha256: of the file, hexadecimal.
    count: points stored.  pose: 4x4 row-major, scan to world.
    skipped: points left out, by reason.
    fault: why the scan was left out of or removed from the archive, or "".
    """

    path: str
    index: int
    sha256: str
    count: int
    format: str
    pose: list[list[float]]
    skipped: dict[str, int]
    fault: str = ""


class SpawnInfo(msgspec.Struct, frozen=True):
    """Initial pose of a scene's users.

    position: of the avatar's origin, world [m].  heading: about `up` [degrees].
    """

    position: tuple[float, float, float]
    heading: float = 0.0


class ObjectInfo(msgspec.Struct, frozen=True):
    """Dynamic object of a scene.

    avatar: its shape, one of the scene's avatars.  pose: 4x4 row-major, the initial pose.
    kind: `kinematic` if users set its pose, `pushed` if users push it. A reader treats any other
    value as kinematic.
    """

    name: str
    avatar: str
    pose: list[list[float]]
    kind: str = "kinematic"


class SceneInfo(msgspec.Struct, frozen=True):
    """Description of a scene: counts, bounds, lattice, radius and sources.

    bounds: [[x, y, z] low, [x, y, z] high], world [m].  origin: of the lattice, world [m].
    lattice_step, voxel_size, radius, radius_error (standard error of `radius`): [m].
    lattice_source: "sources", "given" or "default".
    moved_max: farthest distance that a point moved onto the lattice [m].
    radius_sample: number of points over which the closest-point distance was averaged.
    degree, leaf: of the hierarchies.  skipped: scans left out with `--skip-bad`.
    record_bytes: of all records on disk.  resident_bytes: of the whole archive, decoded.
    effects: all effects that the scene's frames simulate.
    unknown: boxes (like `bounds`) of scans that were left out, where no verdict is CLEAR.
    unknown_everywhere: whether the bounds of one of these scans are not known.
    radius_models: models that are stored and that a query may request.
    generation: how often scans were added or removed since the build.
    radius_now: `radius` as measured over the points of this generation [m]; null: not known.
    radius_now_error: its standard error [m]; null: not known.
    avatars: avatars of the scene, which every client may use by name.
    up: unit vector against gravity.  spawn: where users start; null: each user chooses.
    objects: dynamic objects and their initial poses.
    default_radius_model: model of queries that do not name one; null: `radius` for all points.
    compiling: what the server refuses as `busy`, because it still compiles the kernels: questions,
    "motion" (`move` and motion commands) and "budgets" (questions with a budget).
    """

    scene: str
    format_version: int
    wire_version: int
    points: int
    voxels: int
    bounds: list[list[float]]
    origin: list[float]
    lattice_step: float
    lattice_source: str
    voxel_size: float
    radius: float
    radius_model: str
    radius_error: float
    radius_sample: int
    moved_max: float
    degree: int
    leaf: int
    sources: list[SourceInfo]
    skipped: list[str]
    record_bytes: int
    resident_bytes: int
    effects: list[str] = []
    unknown: list[list[list[float]]] = []
    unknown_everywhere: bool = False
    radius_models: list[str] = []
    generation: int = 0
    radius_now: float | None = None
    radius_now_error: float | None = None
    avatars: list[AvatarInfo] = []
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    spawn: SpawnInfo | None = None
    objects: list[ObjectInfo] = []
    default_radius_model: str | None = None
    compiling: list[str] = []


class ReloadAnswer(msgspec.Struct, frozen=True):
    """Result of a reload: the generation that the scene serves now.

    generation_before, generation_after: of the archive; equal if nothing was added or removed.
    points: in the archive now.  seconds: from the request until the new generation was swapped in.
    """

    scene: str
    generation_before: int
    generation_after: int
    points: int
    seconds: float = 0.0


class ErrorReply(msgspec.Struct, frozen=True):
    """Reason why a request was not answered. A reader treats an unknown code as `internal`."""

    code: Annotated[str, msgspec.Meta(extra_json_schema={"enum": [str(code) for code in ErrorCode]})]
    message: str
