"""A scanned corner with every query about it, as a scene, a server and clients."""

from contextlib import contextmanager
from functools import partial

import archive_cases
import numpy as np
import radius_class_archives
import synthetic_scans
from msgspec import structs
from solidcloud.schemas.wire.answers import (
    CollideAnswers,
    ContactsAnswers,
    DistanceAnswers,
    ObjectsAnswers,
    RaycastAnswers,
    SweepAnswers,
    WithinAnswers,
)
from solidcloud.schemas.wire.arrays import array_fields
from solidcloud.schemas.wire.requests import (
    CollideRequest,
    ContactsRequest,
    DistanceRequest,
    ObjectsRequest,
    RaycastRequest,
    SweepRequest,
    WithinRequest,
    make_objects,
)
from solidcloud.server.client import Client
from solidcloud.server.report.walk.server_process import free_port
from solidcloud.server.scene import Scene
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig

BODY = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.0, 0.2, 0], [0.05, 0.05, 0.3]])
POINTS = synthetic_scans.make_scan("corner", 4, 300)
RNG = np.random.default_rng(11)
POSES = archive_cases.near_poses(RNG, POINTS, BODY, 40, 0.1)
ENDS = archive_cases.near_poses(RNG, POINTS, BODY, 40, 0.1)
RAYS = POINTS[:30] + RNG.normal(0, 0.5, (30, 3))
TOWARDS = np.where(np.arange(30)[:, None] % 2, POINTS[:30] - RAYS, RNG.normal(size=(30, 3)))
OBJECTS = [("al", POSES[0]), ("bo", POSES[0], 2), ("al", POSES[1], 4, 1), ("bo", POSES[2], 1, 0xFFFFFFFE)]
ITEMS, PLACES = make_objects(OBJECTS)

# For each query: the call on a scene or client, the same as a request, the type of its answers, and
# their number.
QUESTIONS = {
    "collide": (
        lambda scene: scene.collide("al", POSES, 0.02),
        CollideRequest("al", POSES, 0.02),
        CollideAnswers,
        40,
    ),
    "collide-bounded": (
        lambda scene: scene.collide("al", POSES, tolerance=0.01),
        CollideRequest("al", POSES, tolerance=0.01),
        CollideAnswers,
        40,
    ),
    "distance": (
        lambda scene: scene.distance("al", POSES, 0.05),
        DistanceRequest("al", POSES, 0.05),
        DistanceAnswers,
        40,
    ),
    "contacts": (
        lambda scene: scene.contacts("al", POSES, 3, 0.05, 0.1),
        ContactsRequest("al", POSES, 3, 0.05, 0.1),
        ContactsAnswers,
        40,
    ),
    "sweep": (
        lambda scene: scene.sweep("al", POSES, ENDS, 0.01, tolerance=1e-4),
        SweepRequest(avatar="al", pose_from=POSES, pose_to=ENDS, margin=0.01, tolerance=1e-4),
        SweepAnswers,
        40,
    ),
    "raycast": (
        lambda scene: scene.raycast(RAYS, TOWARDS, 1.5),
        RaycastRequest(RAYS, TOWARDS, 1.5),
        RaycastAnswers,
        30,
    ),
    "within": (lambda scene: scene.within(RAYS, 0.5), WithinRequest(RAYS, 0.5), WithinAnswers, 30),
    "objects": (
        lambda scene: scene.objects(OBJECTS, 0.01),
        ObjectsRequest(ITEMS, PLACES, 0.01),
        ObjectsAnswers,
        4,
    ),
}

# The same queries with spheres of several sizes.
MODELS = {
    "collide": "border:2",
    "distance": "local:0.1",
    "contacts": "local+border:0.2",
    "sweep": "border:2",
    "raycast": "fixed:0.04",
    "objects": "local:0.1",
}
QUESTIONS |= {
    f"{op}-{model}": (
        lambda scene, ask=QUESTIONS[op][0], model=model: ask(_WithModel(scene, model)),
        structs.replace(QUESTIONS[op][1], radius_model=model),
        *QUESTIONS[op][2:],
    )
    for op, model in MODELS.items()
}


class _WithModel:
    """Scene or client whose queries all use one radius model."""

    def __init__(self, scene, model):
        self._scene, self._model = scene, model

    def __getattr__(self, name):
        return partial(getattr(self._scene, name), radius_model=self._model)


def add_avatars(scene, **client):
    """Add two avatars, "al" and "bo", to a scene or client. client: their owner."""
    scene.add_avatar("al", BODY, 0.01, **client)
    scene.add_avatar("bo", BODY[:2] + 0.01, 0.02, **client)


def same(one, other):
    """Assert that two answers are equal, except for costs in time and loads."""
    assert type(one) is type(other)
    for name in array_fields(type(one)):
        a, b = getattr(one, name), getattr(other, name)
        assert (a.dtype, a.shape) == (b.dtype, b.shape), name
        assert a.tobytes() == b.tobytes(), name


@contextmanager
def opened(folder):
    """Open the corner as a scene, built below `folder`.

    It has its own avatars and those of the client "plain". It has no level of detail: with one, costs
    depend on what is in memory.
    """
    with radius_class_archives.any_classes():
        case = archive_cases.build(folder, POINTS, models=radius_class_archives.STORED)
    with Scene.open(case.archive, "hall", level_bytes=0) as scene:
        add_avatars(scene)
        add_avatars(scene, client="plain")
        yield scene


@contextmanager
def served(scene):
    """Serve the scene; yield the endpoint."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    with serving([scene], ServerConfig(listen=endpoint, avatar_seconds=600.0)):
        yield endpoint


@contextmanager
def client_of(endpoint):
    """Connect a client to the corner and add its avatars."""
    with Client(endpoint, scene="hall", timeout=30.0) as client:
        add_avatars(client)
        yield client
