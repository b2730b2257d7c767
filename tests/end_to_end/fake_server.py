"""A scene that needs no archive: a floor at z = 0, and knobs for what goes wrong. Run: serves it.

The floor is touched where the lowest avatar point's z minus the radius is at most the margin.
"""

import argparse
import threading
import time

import numpy as np
from solidcloud.schemas.answers import CollideAnswers, Verdict
from solidcloud.schemas.errors import BadRequestError, BadTransformError, UnknownAvatarError
from solidcloud.schemas.messages import WIRE_VERSION, AvatarInfo, SceneInfo, SourceInfo
from solidcloud.server.app import serve
from solidcloud.server.config import ServerConfig


def floor_verdicts(points, radius, poses, margin=0.0):
    """The judge: which poses touch the floor."""
    heights = np.einsum("kj,nj->kn", poses[:, 2, :3], points) + poses[:, 2, 3:4]
    touched = heights.min(axis=1) - radius <= margin
    return np.where(touched, Verdict.CONTACT, Verdict.CLEAR).astype(np.uint8)


class FloorScene:
    """What a service asks of a scene. Avatars named "crash" raise, those named "wait" wait for `gate`."""

    def __init__(self, name="floor", delay=0.0):
        self.name, self.delay = name, delay
        self.gate = threading.Event()
        self.avatars = {}
        self.gone = []
        self.at_work = self.warmed = 0
        self.lock = threading.Lock()

    def warm(self):
        self.warmed += 1

    def info(self):
        source = SourceInfo("floor.las", 0, "0" * 64, 4, "las", np.eye(4).tolist(), {"nan": 1})
        return SceneInfo(
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

    def add_avatar(self, name, points, radius=None, *, client=""):
        known = self.avatars.get((client, name))
        if known is not None and not np.array_equal(known[0], points):
            raise BadRequestError(f"avatar {name!r} has other points")
        radius = 0.05 if radius is None else radius
        self.avatars[client, name] = (points, radius)
        return AvatarInfo(name, len(points), radius, 1.0)

    def collide(self, name, poses, margin=0.0, *, client=""):
        if (client, name) not in self.avatars:
            raise UnknownAvatarError(f"avatar {name!r}")
        if not np.array_equal(poses[:, 3], np.tile([0.0, 0, 0, 1], (len(poses), 1))):
            raise BadTransformError("last row")
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
        return CollideAnswers(verdict, outside, ones * 0, ones, ones * 2, engine_seconds=0.25, hits=1, resident=1)

    def drop_client(self, client):
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
    arguments = parser.parse_args()
    serve([FloorScene(arguments.name, arguments.delay)], ServerConfig(listen=arguments.listen))
