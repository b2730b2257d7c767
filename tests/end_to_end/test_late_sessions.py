"""Test sessions over zenoh whose frames do not wait: a State comes while every load is blocked."""

import threading
import time
from pathlib import Path

import effect_rooms
import pytest
from facade_scene import scene_text
from late_frames import PATIENCE, blocked_loads
from solidcloud.schemas.errors import BadRequestError
from solidcloud.server.client import Client
from solidcloud.server.scene import Scene
from solidcloud.server.zenoh_server.serve_loop import serving
from solidcloud.server.zenoh_server.server_config import ServerConfig

SIZE = 6.0
BODY = effect_rooms.body_box()


def test_a_state_comes_while_loads_are_blocked_and_the_avatar_goes_on_after(
    endpoint: str, tmp_path: Path
) -> None:
    archive = effect_rooms.build(tmp_path, effect_rooms.room(SIZE), voxel=1.0).archive
    path = tmp_path / "room.toml"
    path.write_text(scene_text(archive, ("stop", "sweep")))
    start, target = effect_rooms.at(0, 0, 0), effect_rooms.at(SIZE, 0, 0)
    with Scene.open(path, "room") as scene, serving([scene], ServerConfig(listen=endpoint)):  # noqa: SIM117
        with Client(endpoint, scene="room") as client, blocked_loads(scene) as gate:
            client.add_avatar("body", BODY.points, BODY.radius)
            with pytest.raises(BadRequestError, match="'wait' or 'bounds'"):
                client.session("body", late="soon")
            with client.session("body", late="bounds") as session:
                session.wait(session.wish(pose=start), PATIENCE)
                state = session.wait(session.wish(pose=target), PATIENCE)
                assert not gate.is_set()
                assert state.touched[-1].unloaded and state.unknown and 0 < state.unloaded <= state.left
                x = state.pose[0, 0, 3]
                assert x < SIZE / 2
                moved = client.move("body", start, target, late="bounds")
                assert moved.touched[-1].unloaded and moved.pose[0, 0, 3] < SIZE / 2
                gate.set()
                deadline = time.monotonic() + PATIENCE
                while state.unknown:
                    assert time.monotonic() < deadline, f"never came true: {state!r}"
                    state = session.wait(session.wish(pose=target), PATIENCE)
                    threading.Event().wait(0.001)
                assert x < state.pose[0, 0, 3] < SIZE / 2
                assert state.touched[-1].place[0] == SIZE / 2 and not state.touched[-1].unloaded
