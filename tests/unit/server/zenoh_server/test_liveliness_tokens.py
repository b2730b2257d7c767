"""Which clients have a turn of their own."""

import pytest
from solidcloud.server.zenoh_server.liveliness_tokens import ANONYMOUS, Tokens

pytestmark = pytest.mark.interpreted


def test_clients_with_a_token_have_a_turn_and_all_others_share_one():
    tokens = Tokens(2)
    tokens.here("a")
    assert [tokens.turn(client) for client in "abc"] == ["a", ANONYMOUS, ANONYMOUS]
    tokens.gone("a")
    tokens.gone("nobody")
    assert tokens.turn("a") == ANONYMOUS and not tokens.heeded


def test_so_many_tokens_are_heeded_and_the_next_once_one_goes():
    tokens = Tokens(2)
    for client in "abcdefg":
        tokens.here(client)
    assert tokens.heeded == {"a", "b"} and tokens.turn("c") == ANONYMOUS
    tokens.gone("d")
    tokens.gone("a")
    assert tokens.heeded == {"b", "c"}
    tokens.gone("b")
    assert tokens.heeded == {"c"}, "e came when as many waited as are remembered"
    tokens.here("e")
    assert tokens.turn("e") == "e"
