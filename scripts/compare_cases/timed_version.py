"""Process of one version for scripts/compare: runs cases on command and prints their durations.

    python timed_version.py ARCHIVE CASE,CASE,...

The interpreter determines the version. Names are looked up where either version defines them.
"""

import gc
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

from versions import find, scene_file

# Repetitions in one turn, which then takes about 0.1 to 0.3 s; one pose in OBJECTS is an object.
PASSES, SINGLES, FRAMES, TRIPS, WISHES = 20, 4000, 600, 300, 150
OBJECTS, USERS, CROWD_FRAMES = 10, 30, 20
BUILD_POINTS = 10_000_000

Case = Callable[[], None]


def scene_cases(archive: Path, stack: ExitStack) -> dict[str, Case]:
    """Return the cases of a scene in this process."""
    import numpy as np
    from solidcloud.server.scene import Scene

    build_facade = find("build_facade", "builder.synthetic.facade", "builder.made.facade")
    figure_points = find("figure_points", "builder.synthetic.figure", "builder.made.figure")
    walk_poses = find("walk_poses", "builder.synthetic.walk", "builder.made.walk")
    scene = stack.enter_context(Scene.open(archive, budget_bytes=1 << 30))
    figure = figure_points(3617)
    scene.add_avatar("al", figure)
    poses = np.ascontiguousarray(walk_poses(build_facade().truth, 1200, 30.0)[1])
    frames = [np.ascontiguousarray(pose[None]) for pose in poses]
    rng = np.random.default_rng(7)
    origins = poses[:, :3, 3] + [0.0, 0.0, 1.5]
    directions = rng.normal(size=(len(poses), 3))

    def singles() -> None:
        for number in range(SINGLES):
            scene.collide("al", frames[number % len(frames)])

    def collide() -> None:
        for _ in range(PASSES):
            scene.collide("al", poses)

    def contacts() -> None:
        scene.contacts("al", poses, 100)

    def distance() -> None:
        for _ in range(PASSES // 2):
            scene.distance("al", poses, 0.5)

    def sweep() -> None:
        for _ in range(PASSES // 4):
            scene.sweep("al", poses[:-1], poses[1:])

    def raycast() -> None:
        for _ in range(PASSES):
            scene.raycast(origins, directions, 50.0)

    def within() -> None:
        for _ in range(PASSES):
            scene.within(origins, 5.0)

    def objects() -> None:
        for _ in range(PASSES):
            scene.objects([("al", pose) for pose in frames[::OBJECTS]])

    walker = open_walk(scene_file(archive), stack)
    walker.add_avatar("al", figure)
    crowded = open_walk(scene_file(archive, "crowd"), stack)
    clients = [f"user{number}" for number in range(USERS)]
    for client in clients:
        crowded.add_avatar("al", figure, client=client)
    apart = len(poses) // USERS

    def frame() -> None:
        pose = frames[0]
        for number in range(1, FRAMES):
            pose = walker.move("al", pose, frames[number]).pose

    def crowd() -> None:
        # New users each time, so that every turn does the same.
        with ExitStack() as users:
            sessions = [users.enter_context(crowded.session("al", client=client)) for client in clients]
            for number in range(CROWD_FRAMES):
                for user, session in enumerate(sessions):
                    session.wait(session.wish(pose=poses[apart * user + number], time=number / 30))

    return {
        "collide": collide, "single": singles, "distance": distance, "contacts": contacts, "sweep": sweep,
        "raycast": raycast, "within": within, "objects": objects, "frame": frame, "crowd": crowd,
    }  # fmt: skip


def open_walk(path: Path, stack: ExitStack):  # type: ignore[no-untyped-def]
    """Open a scene file."""
    try:
        open_scene = find("open_scene", "server.scenes.open_scene", "server.scene_file")
    except ImportError:  # exists since Scene.open takes scene files, too
        return stack.enter_context(find("Scene", "server.scene").open(path, budget_bytes=1 << 30))
    rooms = ("server.avatars.avatar_file", "server.cli.input.point_file", "server.report.points")
    read_avatar = find("read_avatar", *rooms)
    return stack.enter_context(open_scene(path, read_points=read_avatar, budget_bytes=1 << 30))


def wire_cases(archive: Path, stack: ExitStack) -> dict[str, Case]:
    """Return the cases of a client with a separate server."""
    import numpy as np

    figure_points = find("figure_points", "builder.synthetic.figure", "builder.made.figure")
    client_of = find("Client", "server.client")
    served = find("served", "server.report.walk.server_process", "server.report.serving")
    endpoint = stack.enter_context(served(scene_file(archive), "walk"))
    client = stack.enter_context(client_of(endpoint, scene="walk"))
    client.add_avatar("al", figure_points(3617))
    far = np.eye(4)[None].copy()
    far[0, :3, 3] = 0.0, -1000.0, 0.0
    session = stack.enter_context(client.session("al"))
    session.wait(session.wish(pose=far[0]))

    def round_trip() -> None:
        for _ in range(TRIPS):
            client.collide("al", far)

    def wishes() -> None:
        for _ in range(WISHES):
            session.wait(session.wish(pose=far[0]))

    build_facade = find("build_facade", "builder.synthetic.facade", "builder.made.facade")
    walk_poses = find("walk_poses", "builder.synthetic.walk", "builder.made.walk")
    poses = np.tile(walk_poses(build_facade().truth, 1200, 30.0)[1], (PASSES, 1, 1))

    def path() -> None:
        for _ in client.path("al", poses):
            pass

    return {"round_trip": round_trip, "session": wishes, "path": path}


def build_case(archive: Path, stack: ExitStack) -> dict[str, Case]:
    """Return the case of a build of 10^7 points with two jobs."""
    import shutil
    import subprocess

    scan = archive.parent / "town.laz"
    run = [str(Path(sys.executable).with_name("solidcloud"))]
    if not scan.exists():
        make = [*run, "make", "town", "--points", str(BUILD_POINTS), "-o", str(scan)]
        subprocess.run(make, check=True, stdout=sys.stderr)
    target = archive.parent / f"town{sys.prefix.replace('/', '-')}"

    def build() -> None:
        subprocess.run(
            [*run, "build", str(scan), "-o", str(target), "--jobs", "2"],
            check=True,
            stdout=subprocess.DEVNULL,
        )
        shutil.rmtree(target)

    return {"build": build}


def main() -> None:
    """Prepare the cases, run each once, then run those named on standard input."""
    archive, wanted = Path(sys.argv[1]), sys.argv[2].split(",")
    with ExitStack() as stack:
        cases: dict[str, Case] = {}
        for names, make in (
            (("round_trip", "session", "path"), wire_cases),
            (("build",), build_case),
        ):
            if set(names) & set(wanted):
                cases |= make(archive, stack)
        if set(wanted) - set(cases):
            cases |= scene_cases(archive, stack)
        for name in wanted:
            cases[name]()
        # As a server does (server/runtime/process_heap.py). Otherwise each process has one full
        # collection of 80 ms, in whichever case its count of objects falls due.
        gc.collect()
        gc.freeze()
        print("ready", flush=True)
        for line in sys.stdin:
            begin = time.perf_counter()
            cases[line.strip()]()
            print(f"seconds {time.perf_counter() - begin}", flush=True)


if __name__ == "__main__":
    main()
