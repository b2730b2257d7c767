"""Arguments of the query methods: a scene and a client accept the same ones, and refuse others alike."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from corner import BODY, ENDS, POSES, RAYS, same
from solidcloud import poses
from solidcloud.schemas.errors import BadRequestError, BadTransformError, SolidcloudError, UnknownAvatarError
from solidcloud.schemas.wire.answers import Verdict
from solidcloud.schemas.wire.path_messages import part_to_answers
from solidcloud.schemas.wire.question_table import COLLIDE, join_answers
from solidcloud.server.client import Client
from solidcloud.server.runtime.stop_flag import StopFlag
from solidcloud.server.scene import Scene

POSE, END = POSES[7], ENDS[7]


def along(scene: Any, pose: Any, op: str) -> Any:
    return join_answers([part_to_answers(part) for part in scene.path("al", pose, op)])


# Each query, of a pose and of the end of a motion, which may have any shape that is one pose.
ASKS: dict[str, Callable[[Any, Any, Any], Any]] = {
    "collide": lambda scene, pose, _: scene.collide("al", pose),
    "collide with a margin": lambda scene, pose, _: scene.collide("al", pose, 0.2, budget_ms=1e9),
    "distance": lambda scene, pose, _: scene.distance("al", pose),
    "distance within a tolerance": lambda scene, pose, _: scene.distance("al", pose, tolerance=0.01),
    "contacts": lambda scene, pose, _: scene.contacts("al", pose, 5, 0.2),
    "sweep": lambda scene, pose, end: scene.sweep("al", pose, end),
    "objects": lambda scene, pose, end: scene.objects([("al", pose), ("bo", end, 2)]),
    **{
        f"path of {op}": lambda scene, pose, _, op=op: along(scene, pose, op)
        for op in ("collide", "distance")
    },
}


@pytest.mark.parametrize("ask", ASKS.values(), ids=ASKS)
def test_one_pose_is_a_batch_of_one(
    scene: Scene, client: Client, ask: Callable[[Any, Any, Any], Any]
) -> None:
    expected = ask(scene, POSE[None], END[None])
    assert len(expected) in (1, 2), "an objects query has two items"
    for one in (scene, client):
        same(ask(one, POSE[None], END[None]), expected)
        same(ask(one, POSE, END), expected)
        same(ask(one, POSE.tolist(), np.asfortranarray(END)), expected)


def test_a_motion_ends_at_one_pose(scene: Scene, client: Client) -> None:
    expected = scene.move("al", POSE[None], END[None])
    for one in (scene, client):
        for begin, end in ((POSE, END), (POSE[None], END), (POSE.tolist(), END[None])):
            moved = one.move("al", begin, end)
            assert np.array_equal(moved.pose, expected.pose) and moved.verdict == expected.verdict
        with pytest.raises(BadRequestError, match=r"pose_to of shape \(2, 4, 4\): expected one pose"):
            one.move("al", POSE, POSES[:2])


def test_a_session_takes_one_pose_of_either_shape(scene: Scene, client: Client) -> None:
    for one in (scene, client):
        with one.session("al") as session:
            for pose in (POSE, POSE[None], POSE.tolist()):
                assert session.wait(session.wish(pose), 20.0).pose.shape == (1, 4, 4)
            latest = session.latest()
            assert latest is not None and latest.pose.shape == (1, 4, 4) and 0.0 <= latest.age < 60.0
            for wrong in (POSES[:2], np.eye(3), POSE.ravel()):
                with pytest.raises(BadRequestError, match=r"pose of shape .*: expected one pose, \(4, 4\)"):
                    session.wish(wrong)


def test_a_stopped_query_of_one_pose_has_one_answer(scene: Scene) -> None:
    stop = StopFlag()
    stop.set("stopped before")
    answers = scene.collide("al", POSE, stop=stop)
    assert answers.verdict.tolist() == [Verdict.UNKNOWN]


def test_voxels_are_prefetched_for_a_user_who_gives_one_matrix(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded: list[Any] = []
    with scene.archives[0].take() as opened:
        prefetcher = type(opened.prefetcher)
    monkeypatch.setattr(prefetcher, "record_pose", lambda _, *what: bool(recorded.append(what)))
    scene.collide("al", POSE[None])
    scene.collide("al", POSE)
    assert len(recorded) == 2 and recorded[0] == recorded[1]


def test_other_shapes_are_refused_alike(scene: Scene, client: Client) -> None:
    for wrong in (np.eye(3), POSES[:, :3], POSE.ravel(), POSES[None], np.zeros((5, 7))):
        for one in (scene, client):
            with pytest.raises(BadRequestError, match=r"poses of shape .*: expected \(4, 4\) or \(k, 4, 4\)"):
                one.collide("al", wrong)


def test_float32_rotations_are_refused_with_the_way_out_which_works(scene: Scene, client: Client) -> None:
    rounded = POSES.astype(np.float32)
    exact = scene.distance("al", POSES)
    for one in (scene, client):
        with pytest.raises(BadTransformError, match=r"within 1e-9: solidcloud\.poses\.renormalise returns"):
            one.collide("al", rounded)
        found = one.distance("al", poses.renormalise(rounded))
        near = np.isfinite(exact.signed_distance)
        # A float32 translation of some metres is off by up to 0.2 um, a rotation by 0.1 um a metre.
        assert np.abs(found.signed_distance - exact.signed_distance)[near].max() < 2e-6


def test_distance_has_a_reach_of_a_metre(scene: Scene, client: Client) -> None:
    expected = scene.distance("al", POSES, 1.0)
    for one in (scene, client):
        same(one.distance("al", POSES), expected)
        same(along(one, POSES, "distance"), along(one, POSES, "distance"))
        parts = [part_to_answers(part) for part in one.path("al", POSES, "distance")]
        assert np.array_equal(join_answers(parts).signed_distance, expected.signed_distance)
        with pytest.raises(TypeError, match="'reach'"):
            one.within(RAYS)


@pytest.mark.parametrize(
    ("ask", "said"),
    [
        (
            lambda scene: scene.collide("al", POSES, tolerence=0.01),
            r"\.collide\(\) got an unexpected keyword argument 'tolerence': did you mean 'tolerance'\? it takes margin",
        ),
        (
            lambda scene: scene.distance("al", POSES, rech=2.0),
            r"\.distance\(\) .*'rech': did you mean 'reach'\?",
        ),
        (lambda scene: scene.contacts("al", POSES, margn=2.0), r"\.contacts\(\) .*did you mean 'margin'\?"),
        (lambda scene: scene.sweep("al", POSES, ENDS, budget=3), r"\.sweep\(\) .*did you mean 'budget_"),
        (lambda scene: scene.raycast(RAYS, RAYS, 1.0, model="mean"), r"\.raycast\(\) .*'model'"),
        (
            lambda scene: scene.raycast(RAYS, RAYS, 1.0, tolerance=0.1),
            r"\.raycast\(\) .*'tolerance': it takes reach",
        ),
        (lambda scene: scene.within(RAYS, 1.0, xyz=1), r"\.within\(\) .*'xyz': it takes reach"),
        (lambda scene: scene.objects([], radius=1), r"\.objects\(\) .*did you mean 'radius_model'\?"),
        (
            lambda scene: scene.ask(COLLIDE, "al", POSES, tolerence=1),
            r"\.collide\(\) .*did you mean 'tolerance'\?",
        ),
    ],
)
def test_an_unknown_option_names_the_method_and_the_nearest_option(
    scene: Scene, client: Client, ask: Callable[[Any], Any], said: str
) -> None:
    for one, name in ((scene, "Scene"), (client, "Client")):
        with pytest.raises(TypeError, match=f"^{name}{said}"):
            ask(one)


def test_a_client_has_no_options_of_the_process(client: Client) -> None:
    for name in ("stop", "client"):
        with pytest.raises(TypeError, match=rf"^Client\.collide\(\) .*'{name}'"):
            client.collide("al", POSES, **{name: ""})  # type: ignore[arg-type]


def test_an_unknown_parameter_of_a_path_has_a_suggestion(scene: Scene, client: Client) -> None:
    for one in (scene, client):
        with pytest.raises(
            BadRequestError, match=r"tolerence is not .*: did you mean 'tolerance'\? it takes"
        ):
            list(one.path("al", POSES, tolerence=1.0))


@pytest.mark.parametrize("name", ["", "a" * 65, 7, POSES])
def test_a_name_that_no_avatar_can_have_is_refused_alike(scene: Scene, client: Client, name: Any) -> None:
    said = []
    for one in (scene, client):
        for ask in (
            lambda one=one: one.add_avatar(name, BODY, 0.01),
            lambda one=one: one.collide(name, POSES),
            lambda one=one: one.objects([(name, POSE)]),
            lambda one=one: list(one.path(name, POSES)),
            lambda one=one: one.move(name, POSE, POSE),
        ):
            with pytest.raises(BadRequestError, match=r"^avatar .*1 to 64") as error:
                ask()
            said.append(str(error.value))
        with pytest.raises(BadRequestError, match=r"^avatar of a session .*: expected 1 to 64 of A-Z"):
            one.session(name)
    assert len(set(said)) == 1


@pytest.mark.parametrize("name", ["nobody", "a visitor", "Besucher ä"])
def test_an_avatar_that_was_not_added_is_unknown_to_both(scene: Scene, client: Client, name: str) -> None:
    said = []
    for one in (scene, client):
        with pytest.raises(UnknownAvatarError) as error:
            one.collide(name, POSES)
        said.append(str(error.value))
    assert said[0] == said[1] == f"avatar {name!r} is not known: add it with add_avatar first"


@pytest.mark.parametrize("owner", ["a b", "a" * 65, "a/b", 7])
def test_a_client_that_no_key_can_name_is_refused(scene: Scene, owner: Any) -> None:
    for ask in (
        lambda: scene.add_avatar("other", BODY, 0.01, client=owner),
        lambda: scene.collide("other", POSES, client=owner),
        lambda: scene.session("al", client=owner),
    ):
        with pytest.raises(SolidcloudError, match=r"^client .*: expected 1 to 64 of A-Z"):
            ask()
