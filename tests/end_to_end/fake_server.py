"""A scene without an archive, a floor at z = 0, which can be made to fail. As a program: serve it.

The floor is touched where the z of the lowest avatar point, less the radius, is at most the margin.
"""

import argparse
import threading
import time

import numpy as np
from solidcloud.schemas.errors import BadRequestError, BadTransformError, UnknownAvatarError
from solidcloud.schemas.runtime import compiling
from solidcloud.schemas.scene.effect_table import MOTION_VERSION
from solidcloud.schemas.scene.scene_file import SceneFile, SceneLimits, scene_of
from solidcloud.schemas.wire.answers import (
    CollideAnswers,
    ContactsAnswers,
    DistanceAnswers,
    ObjectsAnswers,
    RaycastAnswers,
    SweepAnswers,
    Verdict,
    WithinAnswers,
)
from solidcloud.schemas.wire.encoding import avatar_digest
from solidcloud.schemas.wire.key_expressions import User
from solidcloud.schemas.wire.motion_messages import Moved, Touched
from solidcloud.schemas.wire.path_messages import answers_to_part
from solidcloud.schemas.wire.question_table import make_unknown
from solidcloud.schemas.wire.scene_messages import (
    WIRE_VERSION,
    AvatarInfo,
    ReloadAnswer,
    SceneInfo,
    SourceInfo,
)
from solidcloud.schemas.wire.stats import StatsAnswer
from solidcloud.server.archives.scene_info import describe_scene
from solidcloud.server.avatars.avatar_model import make_avatar
from solidcloud.server.scene import Scene
from solidcloud.server.scene_interface import AvatarShape, record_avatar
from solidcloud.server.simulation.replay_log import FrameLog, LogHead
from solidcloud.server.simulation.simulation import LocalSession, Simulation
from solidcloud.server.zenoh_server.serve_loop import serve
from solidcloud.server.zenoh_server.server_config import ServerConfig

PART = 10  # poses in a part of a path


def floor_verdicts(points, radius, poses, margin=0.0):
    """Return the verdict of each pose, by the definition of the floor."""
    heights = np.einsum("kj,nj->kn", poses[:, 2, :3], points) + poses[:, 2, 3:4]
    touched = heights.min(axis=1) - radius <= margin
    return np.where(touched, Verdict.CONTACT, Verdict.CLEAR).astype(np.uint8)


class FloorPipeline:
    """Replacement for the effects: an avatar sinks as low as the floor permits.

    An avatar named "crash" raises an error; the states of one named "large" are large.
    """

    bodies = None

    def __init__(self):
        self.frames = 0

    def run(self, body, wish, seconds, budget=None):
        self.frames += 1
        if body.name.endswith("/crash"):
            raise RuntimeError("a secret of the server's own")
        pose = wish.copy()
        lowest = (body.avatar.points @ wish[:3, :3].T)[:, 2].min() - body.avatar.radius
        touched = []
        if wish[2, 3] + lowest <= 0:
            pose[2, 3] = np.nextafter(-lowest, np.inf)
            touched = [Touched((float(wish[0, 3]), float(wish[1, 3]), 0.0))]
        if body.name.endswith("/large"):
            touched = [Touched((0.0, 0.0, 0.0))] * 2000
        body.pose = pose
        left = float(pose[2, 3] - wish[2, 3])
        return Moved(pose=pose[None], left=left, touched=touched, simulated=["stop"])


def floor_simulation(name="floor", users=64, **fields):
    """Return a simulation of the floor with the replacement effects; its `scene` uses it."""
    scene = FloorScene(name)
    scene.file = SceneFile(
        format=1, archives=scene_of(name).archives, limits=SceneLimits(users=users), **fields
    )
    scene.simulation = Simulation(scene, scene.file, FloorPipeline())
    return scene.simulation


class FloorScene:
    """The scene methods that a service calls.

    Avatars named "crash" raise, those named "wait" wait for `gate`.
    """

    overview, voxels, tile, residency_changes = (
        Scene.overview,
        Scene.voxels,
        Scene.tile,
        Scene.residency_changes,
    )

    def __init__(self, name="floor", delay=0.0):
        self.name, self.delay = name, delay
        self.gate = threading.Event()
        self.avatars = {}
        self.gone, self.asked, self.unused = [], [], []
        self.at_work = self.warmed = self.parts = self.reloaded = 0
        self.refuses = None  # error that a reload raises
        self.lock = threading.Lock()
        self.simulation = self.file = None
        self.archives = []
        self.never_warm = ""  # the part whose warming does not end, as if kernels were compiled

    def warm(self, *parts):
        self.warmed += 1
        if self.never_warm in parts:
            compiling._store._begin()
            print(f"warming {self.never_warm}", flush=True)
            threading.Event().wait()

    def info(self):
        source = SourceInfo("floor.las", 0, "0" * 64, 4, "las", np.eye(4).tolist(), {"nan": 1})
        info = SceneInfo(
            self.name,
            format_version=1,
            wire_version=WIRE_VERSION,
            points=4,
            voxels=1,
            bounds=[[-1.0, -1.0, 0.0], [1.0, 1.0, 0.0]],
            origin=[-1.0, -1.0, 0.0],
            lattice_step=0.0001,
            lattice_source="default",
            voxel_size=8.0,
            radius=0.01,
            radius_model="mean",
            radius_error=0.0,
            radius_sample=4,
            moved_max=0.0,
            degree=8,
            leaf=32,
            sources=[source],
            skipped=[],
            record_bytes=100,
            resident_bytes=200,
        )
        return info if self.file is None else describe_scene(info, self.file)

    def reload(self):
        if self.refuses is not None:
            raise self.refuses
        self.reloaded += 1
        return ReloadAnswer(self.name, self.reloaded - 1, self.reloaded, 4)

    def stats(self, keys=False):
        return StatsAnswer(scene=self.name, hits=len(self.asked), keys=[3, 5] if keys else None)

    def add_avatar(self, name, points, radius=None, *, client=""):
        if isinstance(points, AvatarShape):
            points, radius = points.points, points.radius
        known = self.avatars.get((client, name)) or self.avatars.get(("*", name))
        if known is not None and not np.array_equal(known[0], points):
            raise BadRequestError(f"avatar {name!r} has other points")
        radius = 0.05 if radius is None else radius
        self.avatars[client, name] = (np.asarray(points, np.float64), radius)
        return AvatarInfo(name, len(points), radius, 1.0)

    def avatar(self, name, client):
        own = self.avatars.get((client, name))
        found = own or self.avatars.get(("*", name))
        if found is None:
            raise UnknownAvatarError(f"avatar {name!r}")
        digest = b"" if own is None or client == "*" else avatar_digest(*own)
        record_avatar(digest)
        return make_avatar(*found)._replace(digest=digest)

    def move(self, name, pose_from, pose_to, seconds, *, client="", **options):
        if self.simulation is not None:
            return self.simulation.move(name, pose_from, pose_to, seconds, client=client, **options)
        self.check(name, pose_from, client)
        self.asked.append(("move", (name, seconds), options))
        return Moved(pose=pose_to, verdict=int(Verdict.CONTACT), left=0.5, simulated=["stop"])

    def ask(self, question, *arguments, **options):
        return getattr(self, question.name)(*arguments, **options)

    def collide(self, name, poses, margin=0.0, *, client="", **effort):
        self.check(name, poses, client)
        self.asked.append(("collide", (name, margin), effort))
        if name == "crash":
            raise RuntimeError("a secret of the server's own")
        with self.lock:
            self.at_work += 1
        if name == "wait":
            assert self.gate.wait(30)
        if self.delay:
            time.sleep(self.delay)
        k = len(poses)
        points, radius = self.avatars[client, name]
        verdict = floor_verdicts(points, radius, poses, margin)
        ones = np.ones(k, np.uint32)
        outside = np.abs(poses[:, 0, 3]) > 1
        return CollideAnswers(
            verdict, outside, ones * 0, ones, ones * 2, engine_seconds=0.25, hits=1, resident=1
        )

    # All other queries have empty answers, but record their arguments.
    def distance(self, name, poses, reach, *, client="", **effort):
        self.check(name, poses, client)
        return self.keep(DistanceAnswers, len(poses), "distance", (name, reach), effort)

    def contacts(self, name, poses, limit, margin, cluster_distance, *, client="", **effort):
        self.check(name, poses, client)
        asked = (name, limit, margin, cluster_distance)
        return self.keep(ContactsAnswers, len(poses), "contacts", asked, effort)

    def sweep(self, name, pose_from, pose_to, margin, *, client="", **effort):
        self.check(name, pose_from, client)
        self.check_poses(pose_to)
        return self.keep(SweepAnswers, len(pose_from), "sweep", (name, margin), effort)

    def raycast(self, origins, directions, reach, **effort):
        assert origins.shape == directions.shape == (len(origins), 3)
        return self.keep(RaycastAnswers, len(origins), "raycast", (reach,), effort)

    def within(self, points, reach, **effort):
        assert points.shape == (len(points), 3)
        return self.keep(WithinAnswers, len(points), "within", (reach,), effort)

    def objects(self, objects, margin, *, client="", **effort):
        for name, pose, _, _ in objects:
            self.check(name, pose[None], client)
        asked = tuple((name, group, mask) for name, _, group, mask in objects)
        return self.keep(ObjectsAnswers, len(objects), "objects", (asked, margin), effort)

    def path(self, name, poses, op, *, client="", **parameters):
        """Yield parts of PART poses.

        After the first, it waits with an avatar named "wait", and raises with one named "crash".
        """
        self.check(name, poses, client)
        self.asked.append(("path", (name, op), parameters))

        def parts():
            for first in range(0, max(1, len(poses)), PART):
                if first and name == "wait":
                    assert self.gate.wait(30)
                if first and name == "crash":
                    raise RuntimeError("a secret of the server's own")
                if first and name == "refuse":
                    raise BadTransformError("as such")
                if self.delay:
                    time.sleep(self.delay)
                points, radius = self.avatars[client, name]
                part = poses[first : first + PART]
                verdict = floor_verdicts(points, radius, part, parameters.get("margin", 0.0))
                ones = np.ones(len(part), np.uint32)
                self.parts += 1
                answers = CollideAnswers(verdict, ones > 1, ones * 0, ones, ones * 2)
                yield answers_to_part(answers, first, len(poses))

        return parts()

    def check(self, name, poses, client):
        if (client, name) not in self.avatars:
            raise UnknownAvatarError(f"avatar {name!r}")
        record_avatar(avatar_digest(*self.avatars[client, name]))
        self.check_poses(poses)

    def check_poses(self, poses):
        if not np.array_equal(poses[:, 3], np.tile([0.0, 0, 0, 1], (len(poses), 1))):
            raise BadTransformError("last row")

    def keep(self, kind, k, operation, asked, effort):
        self.asked.append((operation, asked, effort))
        return make_unknown(kind, k)

    def limit_avatars(self, limits):
        self.limits = limits

    def drop_unused_avatars(self, alive, seconds):
        self.unused.append((set(alive), seconds))

    def session(self, avatar, *, client=""):
        return LocalSession(self.simulation, User(client, avatar))

    def drop_client(self, client):
        if self.simulation is not None:
            self.simulation.drop_client(client)
        else:
            self.forget_client(client)

    def forget_client(self, client):
        for key in [key for key in self.avatars if key[0] == client]:
            del self.avatars[key]
        self.gone.append(client)

    def close(self):
        pass


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("listen")
    parser.add_argument("--name", default="floor")
    parser.add_argument("--delay", type=float, default=0.0)
    parser.add_argument("--walked", action="store_true", help="users may walk it")
    parser.add_argument("--log")
    parser.add_argument("--never-warm", default="", metavar="PART")
    parser.add_argument("--stop-seconds", type=float, default=1.0)
    arguments = parser.parse_args()
    scene = FloorScene(arguments.name, arguments.delay)
    if arguments.walked:
        scene = floor_simulation(arguments.name).scene
    scene.never_warm = arguments.never_warm
    if arguments.log:
        scene.simulation.record(FrameLog(arguments.log, LogHead(arguments.name, "", b"", [], MOTION_VERSION)))
    serve([scene], ServerConfig(listen=arguments.listen, stop_seconds=arguments.stop_seconds))
