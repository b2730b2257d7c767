"""Mixed requests of every query as bytes, and the bytes of the replies without costs and times.

python mixed_requests.py ARCHIVE COUNT prints a checksum of each reply. Another process must print
the same.
"""

import hashlib
import json
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import archive_cases
import msgspec
import numpy as np
import synthetic_scans
from numpy.typing import NDArray
from solidcloud.schemas.wire.encoding import MSGPACK, decode_answer, encode
from solidcloud.schemas.wire.question_table import QUESTIONS
from solidcloud.schemas.wire.requests import (
    AddAvatarRequest,
    CollideRequest,
    ContactsRequest,
    DistanceRequest,
    ObjectEntry,
    ObjectsRequest,
    QuestionRequest,
    RaycastRequest,
    SweepRequest,
    WithinRequest,
)
from solidcloud.server.scene import Scene
from solidcloud.server.zenoh_server.request_dispatcher import RequestDispatcher
from solidcloud.server.zenoh_server.server_config import ServerConfig

SCAN = ("corner", 21, 500)
MODELS = ("mean:1.5", "local", "border", "local+border:0.8", "fixed:0.004")
# Columns that depend on the clock and on resident voxels, which are searched first: times, counters of the
# cache, and the cost of the search.
COSTS = {
    "engine_seconds": 0.0,
    "wait_seconds": 0.0,
    "hits": 0,
    "misses": 0,
    "resident": 0,
    "resident_bytes": 0,
    "node_visits": np.zeros(1),
    "point_tests": np.zeros(1),
}


def question(
    rng: np.random.Generator, points: NDArray[np.float64], body: NDArray[np.float64]
) -> tuple[str, QuestionRequest]:
    """Return an exact request of any query, with any radius model.

    Which of two answers within a tolerance is given depends on what is in memory.
    """
    poses = archive_cases.near_poses(rng, points, body, int(rng.integers(1, 4)), 0.15)
    effort: dict[str, Any] = {}
    if rng.random() < 0.5:
        effort["radius_model"] = str(rng.choice(MODELS))
    op = str(rng.choice(list(QUESTIONS)))
    starts = rng.uniform(0, 2, (2, 3))
    asked: QuestionRequest
    if op == "collide":
        asked = CollideRequest("body", poses, 0.002, **effort)
    elif op == "distance":
        asked = DistanceRequest("body", poses, 0.2, **effort)
    elif op == "contacts":
        asked = ContactsRequest("body", poses, 10, 0.01, **effort)
    elif op == "sweep":
        asked = SweepRequest(avatar="body", pose_from=poses, pose_to=poses[::-1].copy(), **effort)
    elif op == "raycast":
        asked = RaycastRequest(starts, points[rng.integers(len(points), size=2)] - starts, 2.0, **effort)
    elif op == "within":
        asked = WithinRequest(starts, 0.3, **effort)
    else:
        asked = ObjectsRequest([ObjectEntry("body")] * len(poses), poses, 0.01, **effort)
    return op, asked


def requests(count: int) -> list[tuple[str, bytes]]:
    """Return operations and payloads: an avatar, and those of `count` requests."""
    rng = np.random.default_rng(25)
    body, points = rng.uniform(-0.15, 0.15, (12, 3)), synthetic_scans.make_scan(*SCAN)
    found = [("add_avatar", encode(AddAvatarRequest("body", body, 0.01), MSGPACK))]
    for _ in range(count):
        op, asked = question(rng, points, body)
        found.append((op, encode(asked, MSGPACK)))
    return found


def checksums(
    archive: Path, asked: Sequence[tuple[str, bytes]], threads: int, budget_bytes: int
) -> list[str]:
    """Return a checksum of the bytes of each reply without costs.

    The first request is answered before all others.
    """
    with Scene.open(archive, "scene", budget_bytes=budget_bytes) as scene:
        service = RequestDispatcher([scene], ServerConfig())

        def reply(request: tuple[str, bytes]) -> str:
            op, payload = request
            answer = service.answer(f"solidcloud/1/scene/scene/c/{op}", payload, MSGPACK)
            assert answer.ok, answer.payload
            if op not in QUESTIONS:
                return ""
            found = decode_answer(QUESTIONS[op].answers, answer.payload, MSGPACK)
            plain = msgspec.structs.replace(found, **COSTS)
            return hashlib.sha256(encode(plain, MSGPACK)).hexdigest()[:16]

        reply(asked[0])
        with ThreadPoolExecutor(threads) as pool:
            found = list(pool.map(reply, asked[1:]))
        scene.residency.check()
    return found


if __name__ == "__main__":
    print(json.dumps(checksums(Path(sys.argv[1]), requests(int(sys.argv[2])), 1, 1 << 26)))
