"""Users in contact with the scan: they can leave it, and never pass it (SCENE.md, "A user in contact")."""

from pathlib import Path

import effect_rooms
import numpy as np
import pytest
from effect_frames import flip_a_byte
from effect_rooms import RADIUS, at, play
from solidcloud.schemas.archive.archive import Archive
from solidcloud.schemas.scene.effect_table import AnyEffect, Ground, Slide, Step, Stop, Sweep
from solidcloud.schemas.scene.scene_file import ArchiveItem, SceneFile
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.server.avatars.avatar_model import AvatarModel, make_avatar
from solidcloud.server.scene import Scene
from solidcloud.server.simulation.effects import motion_effects
from solidcloud.server.simulation.simulation import make_pipeline
from solidcloud.server.simulation.world.collision_world import World
from solidcloud.server.simulation.world.first_hits import leave
from solidcloud.server.simulation.world.frame import Body, Frame

EFFECTS: list[AnyEffect] = [Stop(), Sweep(), Slide(), Step(), Ground()]
WAYS = [np.array([np.cos(a), np.sin(a), 0.0]) for a in np.arange(8) * np.pi / 4]
SPHERE, WIDE, TALL = 0.04, 0.21, 0.9


def shell() -> AvatarModel:
    """Return a hollow upright cylinder, its axis at the origin, its feet at z = 0."""
    turns, heights = np.arange(22) * 2 * np.pi / 22, np.linspace(SPHERE, TALL - SPHERE, 15)
    side = [[WIDE * np.cos(a), WIDE * np.sin(a), z] for a in turns for z in heights]
    ends = [
        [r * np.cos(a), r * np.sin(a), z] for r in (0.0, 0.07, 0.14) for a in turns for z in heights[[0, -1]]
    ]
    return make_avatar(side + ends, SPHERE)


def walls(shape: str, rng: np.random.Generator, noise: float) -> np.ndarray:
    """Return the sheet y = 0, the half of it with x < 0, or a corner with the sheet x = 0."""
    low = 0.0 if shape == "corner" else -1.2
    sheet = effect_rooms.plane((low, 0, -0.4), (0.0 if shape == "jamb" else 1.2, 0, 1.4))
    points = np.r_[sheet, sheet[:, [1, 0, 2]]] if shape == "corner" else sheet
    return points + rng.normal(0.0, noise, points.shape)


def passes(shape: str, begin: np.ndarray, end: np.ndarray) -> bool:
    """Return whether the axis crosses a sheet between two places (2,)."""
    for across in (0, 1) if shape == "corner" else (1,):
        if (begin[across] < 0.0) != (end[across] < 0.0):
            share = begin[across] / (begin[across] - end[across])
            at_x = begin[1 - across] + share * (end[1 - across] - begin[1 - across])
            low, high = 0.0 if shape == "corner" else -2.0, 0.0 if shape == "jamb" else 2.0
            return bool(low < at_x < high)
    return False


@pytest.mark.parametrize("pops", [True, False])
@pytest.mark.parametrize("shape", ["sheet", "jamb", "corner"])
def test_who_overlaps_a_thin_wall_leaves_it_and_never_through(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, shape: str, pops: bool
) -> None:
    """Issue 35: a user 6 cm deep in a sheet could not move in any direction.

    Without `pops`, only motion commands lead out.
    """
    if not pops:
        monkeypatch.setattr(motion_effects, "_ESCAPE_DISTANCES", ())
    case = effect_rooms.build(tmp_path, walls(shape, rng, 0.002))
    avatar, reach = shell(), WIDE + SPHERE + RADIUS
    with play(case.archive, Stop(), Sweep(), Slide()) as game:
        for _ in range(3):
            near, side = rng.uniform(0.06, reach - 0.02), rng.choice([-1.0, 1.0])
            start = {"sheet": (0.0, side * near), "jamb": (-0.1, side * near), "corner": (near, 0.25)}[shape]
            free = 0
            for way in WAYS:
                body = game.body(avatar, at(*start, 0.0, rng.uniform(0, 6)))
                assert game.touches(body)
                for _ in range(45):
                    before = body.pose[:2, 3].copy()
                    moved = game.go(body, 0.04 * way)
                    assert not passes(shape, before, body.pose[:2, 3]), (shape, start, way)
                    if moved.verdict == Verdict.CLEAR:
                        break
                free += moved.verdict == Verdict.CLEAR
                assert bool(moved.verdict == Verdict.CONTACT) == game.touches(body)
            assert free > 0, (shape, start)


def test_a_motion_in_contact_obeys_the_rule_by_its_definition(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    """The naive twin: brute force over all pairs of points, at many moments of a motion."""
    case = effect_rooms.build(tmp_path, walls("corner", rng, 0.002))
    points, avatar, allowed = case.points, shell(), 0
    axis = np.array([[0.0, 0.0, z] for z in np.linspace(0.25, 0.65, 41)])
    with play(case.archive, Stop(), Sweep()) as game, game.world:
        for _ in range(40):
            body = game.body(avatar, at(*rng.uniform(0.08, 0.2, 2), 0.0))
            frame = Frame(body, body.pose, 1 / 30, game.world, pose=body.pose)
            way = rng.normal(0.0, 0.05, 3) * [1, 1, 0.3]
            to = body.pose.copy()
            to[:3, 3] += way
            hit = leave(frame, to, 0.002)
            end = to if hit is None else hit.end
            moved = end[:3, 3] - body.pose[:3, 3]
            allowed += bool(moved.any())
            touched = [_touched(points, avatar, body.pose[:3, 3] + t * moved) for t in np.linspace(0, 1, 9)]
            inside = _inside(points, avatar, body.pose[:3, 3])
            leaves = np.zeros(len(points), bool)
            for across in (0, 1):  # the walls x = 0 and y = 0
                if moved[across] > 0.15 * np.linalg.norm(moved):
                    leaves |= np.abs(points[:, across]) < 0.05
            for now in touched[1:]:
                assert not (now & ~touched[0] & ~inside & ~leaves).any(), "another surface is newly touched"
            # The nearest point to the core comes no nearer than its plane, 2 cm before it or half of the way.
            gaps = [
                np.linalg.norm(points[None] - (axis + body.pose[:3, 3] + t * moved)[:, None], axis=2).min()
                for t in np.linspace(0, 1, 9)
            ]
            assert min(gaps) >= gaps[0] - min(0.02, 0.5 * gaps[0]) - 1e-3
    assert allowed > 5


def _touched(points: np.ndarray, avatar: AvatarModel, place: np.ndarray) -> np.ndarray:
    gaps = np.linalg.norm(points[:, None] - (avatar.points + place)[None], axis=2)
    return np.asarray(gaps.min(axis=1) <= SPHERE + RADIUS - 1e-4)


def _inside(points: np.ndarray, avatar: AvatarModel, place: np.ndarray) -> np.ndarray:
    """Return which points lie in the avatar's spheres' cylinder, 2 % larger."""
    gap = points - place
    level = np.hypot(gap[:, 0], gap[:, 1]) <= 1.02 * (WIDE + SPHERE + RADIUS)
    return np.asarray(level & (gap[:, 2] >= -RADIUS - 0.02) & (gap[:, 2] <= TALL + RADIUS + 0.02))


def test_a_frame_that_cannot_read_a_voxel_around_says_so(tmp_path: Path, rng: np.random.Generator) -> None:
    """It is in contact, but might leave if the voxel were read."""
    case = effect_rooms.build(tmp_path, walls("sheet", rng, 0.0), voxel=0.5)
    with Archive(case.archive) as archive:
        voxels = [tuple(each) for each in archive.coordinates.tolist()]
    flip_a_byte(case.archive, max(voxels))
    with play(case.archive, Stop(), Sweep()) as game:
        body = game.body(shell(), at(0.35, -0.2, 0))
        moved = game.go(body, (0, -0.04, 0))
    assert moved.unknown and moved.verdict == Verdict.CONTACT and body.pose[1, 3] == -0.2


def test_who_stands_in_the_floor_is_lifted_and_walks(tmp_path: Path) -> None:
    floor = effect_rooms.plane((-1.2, -1.2, 0), (1.2, 1.2, 0))
    case = effect_rooms.build(tmp_path, floor)
    with play(case.archive, *EFFECTS) as game:
        body = game.body(shell(), at(0, 0, -0.02))
        assert game.touches(body)
        for _ in range(20):
            moved = game.go(body, (0.03, 0, 0))
        assert moved.verdict == Verdict.CLEAR and body.on_ground
        assert body.pose[0, 3] > 0.5 and body.pose[2, 3] == pytest.approx(RADIUS + 0.03, abs=0.01)


@pytest.mark.parametrize("effects", [[Stop()], [Stop(), Sweep()]])
def test_a_turn_waits_until_the_user_is_out(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch, effects: list[AnyEffect]
) -> None:
    monkeypatch.setattr(motion_effects, "_ESCAPE_DISTANCES", ())
    case = effect_rooms.build(tmp_path, walls("sheet", rng, 0.0))
    with play(case.archive, *effects) as game:
        body = game.body(shell(), at(0, -0.15, 0))
        turned = at(0, 0, 0, 0.1)[:3, :3]
        moved = game.go(body, (0, -0.04, 0), turned)
        assert moved.verdict == Verdict.CONTACT and body.pose[1, 3] == pytest.approx(-0.19)
        assert np.array_equal(body.pose[:3, :3], np.eye(3))
        for _ in range(5):
            moved = game.go(body, (0, -0.04, 0), turned)
        assert moved.verdict == Verdict.CLEAR and np.allclose(body.pose[:3, :3], turned)


def test_walls_of_two_archives_hold_a_user_alike(
    tmp_path: Path, rng: np.random.Generator, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(motion_effects, "_ESCAPE_DISTANCES", ())
    sheet = effect_rooms.build(tmp_path, walls("sheet", rng, 0.0)).archive
    turned = at(0.25, 0, 0, np.pi / 2).tolist()
    archives = [ArchiveItem(path=str(sheet)), ArchiveItem(path=str(sheet), pose=turned)]
    file = SceneFile(format=1, archives=archives, effects=[Stop(), Sweep(), Slide()])
    text = f'format = 1\n[[archives]]\npath = "{sheet}"\n[[archives]]\npath = "{sheet}"\npose = {turned}\n'
    (tmp_path / "two.toml").write_text(text)
    with Scene.open(tmp_path / "two.toml") as scene:
        world = World(scene, file)
        pipeline = make_pipeline(file, world)
        body = Body("c/a", shell(), at(0.05, -0.2, 0), user=("c", "a"))
        for way in [(0, 0.04, 0), (0.04, 0, 0)] * 10:
            target = body.pose.copy()
            target[:3, 3] += way
            pipeline.run(body, target)
        assert body.pose[0, 3] <= 0.051 and body.pose[1, 3] <= -0.199, "into neither"
        for _ in range(20):
            target = body.pose.copy()
            target[:3, 3] += (-0.03, -0.03, 0)
            moved = pipeline.run(body, target)
        assert moved.verdict == Verdict.CLEAR
