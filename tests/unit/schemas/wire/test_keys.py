"""Key expressions: what they look like, and what may not stand in one."""

import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.wire import keys
from solidcloud.schemas.wire.messages import WIRE_VERSION


def test_keys_look_as_in_the_document():
    assert keys.scenes_key() == "solidcloud/1/scenes"
    assert keys.question_key("hall", "c-1", "collide") == "solidcloud/1/scene/hall/c-1/collide"
    assert keys.questions_key("hall") == "solidcloud/1/scene/hall/*/*"
    assert keys.server_alive_key("hall", "ab12") == "solidcloud/1/alive/hall/ab12"
    assert keys.client_alive_key("hall", "c-1") == "solidcloud/1/client/hall/c-1"
    assert keys.clients_alive_key("hall") == "solidcloud/1/client/hall/*"
    user = keys.User("c-1", "al")
    assert keys.wish_key("hall", user) == "solidcloud/1/wish/hall/c-1/al"
    assert keys.wishes_key("hall") == "solidcloud/1/wish/hall/*/*"
    assert keys.state_key("hall", user) == "solidcloud/1/state/hall/c-1/al"
    assert keys.states_key("hall") == "solidcloud/1/state/hall/*/*"
    assert f"solidcloud/{WIRE_VERSION}" == keys.ROOT


def test_a_question_is_read_as_it_was_written():
    for operation in keys.operations():
        route = keys.parse_question(keys.question_key("St.Peter_2", "a", operation))
        assert route == keys.Route("St.Peter_2", "a", operation)


def test_a_wish_is_read_as_it_was_written():
    user = keys.User("c-1", "al.2")
    assert keys.parse_wish(keys.wish_key("hall", user)) == user
    assert keys.parse_state(keys.state_key("hall", user)) == user


def test_a_token_is_read_as_it_was_written_and_no_wider_one():
    assert keys.parse_client_alive(keys.client_alive_key("hall", "c-1")) == "c-1"
    for key in ("solidcloud/1/client/hall/*", "solidcloud/1/client/**", "solidcloud/1/client/hall/c/x", "**"):
        with pytest.raises(BadRequestError):
            keys.parse_client_alive(key)


def test_others_are_told_a_name_that_the_id_cannot_be_found_from():
    assert keys.public_id("abc") == "ba7816bf8f01"


@pytest.mark.parametrize(
    "key",
    [
        "solidcloud/1/wish/hall/c",
        "solidcloud/1/wish/hall/c/al/x",
        "solidcloud/1/wish/hall/*/al",
        "solidcloud/1/state/hall/c/al",
    ],
)
def test_keys_that_are_no_wish_are_refused(key):
    with pytest.raises(BadRequestError):
        keys.parse_wish(key)


@pytest.mark.parametrize("name", ["", "a" * 65, "a/b", "*", "**", "a b", "häll", "a\n", "$*", "a?b", "#"])
def test_bad_names_are_refused(name):
    for make in (
        lambda: keys.question_key(name, "c", "info"),
        lambda: keys.question_key("hall", name, "info"),
        lambda: keys.questions_key(name),
        lambda: keys.client_alive_key("hall", name),
        lambda: keys.server_alive_key(name, "s"),
        lambda: keys.wish_key("hall", keys.User("c", name)),
        lambda: keys.state_key("hall", keys.User(name, "al")),
        lambda: keys.wishes_key(name),
    ):
        with pytest.raises(BadRequestError, match="expected 1 to 64"):
            make()


def test_longest_name_is_allowed():
    assert keys.check_name("a" * 64, "scene") == "a" * 64


@pytest.mark.parametrize(
    "key",
    [
        "solidcloud/1/scene/hall/c",
        "solidcloud/1/scene/hall/c/info/x",
        "solidcloud/1/scene/hall/c/effects",
        "solidcloud/1/scene/hall/*/info",
        "solidcloud/1/scene/**",
        "solidcloud/2/scene/hall/c/info",
        "other/1/scene/hall/c/info",
        "",
    ],
)
def test_keys_that_are_no_question_are_refused(key):
    with pytest.raises(BadRequestError):
        keys.parse_question(key)
