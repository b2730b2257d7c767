"""Key expressions: what they look like, and what may not stand in one."""

import pytest
from solidcloud.schemas.errors import BadRequestError
from solidcloud.schemas.wire import key_expressions
from solidcloud.schemas.wire.scene_messages import WIRE_VERSION


def test_keys_look_as_in_the_document():
    assert key_expressions.scenes_key() == "solidcloud/1/scenes"
    assert key_expressions.query_key("hall", "c-1", "collide") == "solidcloud/1/scene/hall/c-1/collide"
    assert key_expressions.all_queries_key("hall") == "solidcloud/1/scene/hall/*/*"
    assert key_expressions.server_token_key("hall", "ab12") == "solidcloud/1/alive/hall/ab12"
    assert key_expressions.client_token_key("hall", "c-1") == "solidcloud/1/client/hall/c-1"
    assert key_expressions.all_client_tokens_key("hall") == "solidcloud/1/client/hall/*"
    user = key_expressions.User("c-1", "al")
    assert key_expressions.command_key("hall", user) == "solidcloud/1/wish/hall/c-1/al"
    assert key_expressions.all_commands_key("hall") == "solidcloud/1/wish/hall/*/*"
    assert key_expressions.state_key("hall", user) == "solidcloud/1/state/hall/c-1/al"
    assert key_expressions.all_states_key("hall") == "solidcloud/1/state/hall/*/*"
    assert key_expressions.residency_key("hall", "c-1") == "solidcloud/1/residency/hall/c-1"
    assert key_expressions.all_residency_key("hall") == "solidcloud/1/residency/hall/*"
    assert f"solidcloud/{WIRE_VERSION}" == key_expressions.ROOT


def test_a_question_is_read_as_it_was_written():
    for operation in key_expressions.operations():
        route = key_expressions.parse_query_key(key_expressions.query_key("St.Peter_2", "a", operation))
        assert route == key_expressions.Route("St.Peter_2", "a", operation)


def test_a_wish_is_read_as_it_was_written():
    user = key_expressions.User("c-1", "al.2")
    assert key_expressions.parse_command_key(key_expressions.command_key("hall", user)) == user
    assert key_expressions.parse_state_key(key_expressions.state_key("hall", user)) == user


def test_a_token_is_read_as_it_was_written_and_no_wider_one():
    assert key_expressions.parse_client_token(key_expressions.client_token_key("hall", "c-1")) == "c-1"
    for key in ("solidcloud/1/client/hall/*", "solidcloud/1/client/**", "solidcloud/1/client/hall/c/x", "**"):
        with pytest.raises(BadRequestError):
            key_expressions.parse_client_token(key)


def test_a_query_for_changes_is_read_as_it_was_written_and_no_wider_one():
    assert key_expressions.parse_residency_key(key_expressions.residency_key("hall", "c-1")) == "c-1"
    for key in (
        "solidcloud/1/residency/hall/*",
        "solidcloud/1/residency/hall/c/x",
        "solidcloud/1/client/hall/c",
    ):
        with pytest.raises(BadRequestError):
            key_expressions.parse_residency_key(key)


@pytest.mark.parametrize("name", ["", "a" * 65, "a/b", "*", "**", "a b", "häll", "a\n", "$*", "a?b", "#"])
def test_bad_names_are_refused(name):
    for make in (
        lambda: key_expressions.query_key(name, "c", "info"),
        lambda: key_expressions.query_key("hall", name, "info"),
        lambda: key_expressions.all_queries_key(name),
        lambda: key_expressions.client_token_key("hall", name),
        lambda: key_expressions.server_token_key(name, "s"),
        lambda: key_expressions.command_key("hall", key_expressions.User("c", name)),
        lambda: key_expressions.state_key("hall", key_expressions.User(name, "al")),
        lambda: key_expressions.all_commands_key(name),
    ):
        with pytest.raises(BadRequestError, match="expected 1 to 64"):
            make()


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
        key_expressions.parse_query_key(key)
