"""Record of the answers, messages and logs of one version, for scripts/compare_answers.

Runs in the environment of that version, from any checkout:

    python recorded_version.py answers ARCHIVE
    python recorded_version.py messages
    python recorded_version.py walk ENDPOINT

`answers` prints digests of the answers of a scene in this process, by case and field. `messages`
prints requests in both encodings, in hex. `walk` runs a session over zenoh with the server at
ENDPOINT.
"""

import hashlib
import json
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from versions import VOLATILE, find

POSES, STEPS = 64, 120


def main() -> None:
    """Run the command; print its result as JSON."""
    command, *arguments = sys.argv[1:]
    commands: dict[str, Any] = {"answers": answers, "messages": messages, "walk": walk}
    print(json.dumps(commands[command](*arguments)))


def content() -> dict[str, Any]:
    """Return the avatar and the arguments of all requests; the same numbers in each version."""
    build_facade = find("build_facade", "builder.synthetic.facade", "builder.made.facade")
    figure_points = find("figure_points", "builder.synthetic.figure", "builder.made.figure")
    walk_poses = find("walk_poses", "builder.synthetic.walk", "builder.made.walk")
    poses = np.ascontiguousarray(walk_poses(build_facade().truth, 1200, 30.0)[1][:: 1200 // POSES])
    rng = np.random.default_rng(20)
    origins = np.ascontiguousarray(poses[:, :3, 3] + [0.0, 0.0, 1.5])
    return {
        "figure": figure_points(800),
        "poses": poses,
        "origins": origins,
        "directions": rng.normal(size=origins.shape),
    }


def answers(archive: str) -> dict[str, dict[str, str]]:
    """Query a scene in this process; return the digest of each field of each answer."""
    from solidcloud.server.scene import Scene

    given = content()
    poses, origins = given["poses"], given["origins"]
    options: list[dict[str, Any]] = [
        {},
        {"tolerance": 0.05},
        {"budget_visits": 40},
        {"tolerance": 0.02, "budget_visits": 200},
    ]
    found: dict[str, dict[str, str]] = {}
    with Scene.open(Path(archive), budget_bytes=1 << 30) as scene:
        scene.add_avatar("al", given["figure"])
        # Load everything first, so that the hits and misses of a case do not depend on the order of
        # the cases.
        scene.distance("al", poses, 8.0)
        things = [("al", pose) for pose in poses[::4]]
        for more in options:
            cases = {
                "collide": lambda more=more: scene.collide("al", poses, 0.02, **more),
                "one pose": lambda more=more: scene.collide("al", poses[3:4], **more),
                "distance": lambda more=more: scene.distance("al", poses, 0.5, **more),
                "contacts": lambda more=more: scene.contacts("al", poses, 50, 0.05, **more),
                "sweep": lambda more=more: scene.sweep("al", poses[:-1], poses[1:], **more),
                "raycast": lambda more=more: scene.raycast(origins, given["directions"], 40.0, **more),
                "within": lambda more=more: scene.within(origins, 3.0, **more),
                "objects": lambda more=more: scene.objects(things, 0.05, **more),
            }
            for name, case in cases.items():
                found[f"{name} {more}"] = digests(msgspec.structs.asdict(case()))
    return found


def digests(fields: dict[str, Any]) -> dict[str, str]:
    """Return the digest of each field that is part of the answer."""
    return {name: digest(value) for name, value in fields.items() if name not in VOLATILE}


def digest(value: Any) -> str:
    """Return a digest of an array (dtype, shape, bytes) or of any other value."""
    if isinstance(value, np.ndarray):
        head = f"{value.dtype.str} {value.shape} ".encode()
        return hashlib.sha256(head + np.ascontiguousarray(value).tobytes()).hexdigest()[:16]
    return repr(value)


def messages() -> dict[str, dict[str, str]]:
    """Return the requests in both encodings, in hex, by operation."""
    encode, encodings = find("encode", "schemas.wire.encoding", "schemas.encoding"), {}
    for name in ("MSGPACK", "JSON"):
        encodings[name] = find(name, "schemas.wire.encoding", "schemas.encoding")

    def of(kind: str) -> Any:
        return find(kind, "schemas.wire.requests", "schemas.wire.path_messages", "schemas.requests")

    move = find("MoveRequest", "schemas.wire.motion_messages", "schemas.moves")
    given = content()
    poses, origins = given["poses"], given["origins"]
    avatar, rows = {"avatar": "al"}, {"avatar": "al", "poses": poses}
    items = [of("ObjectEntry ObjectItem")(avatar="al", group=1 + number) for number in range(8)]
    requests = {
        "add_avatar": of("AddAvatarRequest")(name="al", points=given["figure"]),
        "collide": of("CollideRequest")(**rows, margin=0.02),
        "distance": of("DistanceRequest")(**rows, reach=0.5),
        "contacts": of("ContactsRequest")(**rows, limit=20, cluster_distance=0.5),
        "sweep": of("SweepRequest")(**avatar, pose_from=poses[:-1], pose_to=poses[1:]),
        "raycast": of("RaycastRequest")(origins=origins, directions=given["directions"], reach=40.0),
        "within": of("WithinRequest")(points=origins, reach=3.0, tolerance=0.01),
        "objects": of("ObjectsRequest")(objects=items, poses=np.ascontiguousarray(poses[:8])),
        "path": of("PathRequest")(**rows, op="distance", reach=0.5),
        "move": move(avatar="al", pose_from=poses[:1], pose_to=np.ascontiguousarray(poses[1:2])),
    }
    return {
        name: {encoding: encode(request, kind).hex() for encoding, kind in encodings.items()}
        for name, request in requests.items()
    }


def walk(endpoint: str) -> int:
    """Send motion commands of a session, one after another's state; return their number."""
    given = content()
    client_of = find("Client", "server.client")
    with client_of(endpoint, scene="walk") as client:
        client.add_avatar("al", given["figure"])
        with client.session("al") as session:
            for number in range(STEPS):
                pose = given["poses"][0].copy()
                pose[1, 3] += 0.05 * number
                session.wait(session.wish(pose=pose))
    return STEPS


if __name__ == "__main__":
    main()
