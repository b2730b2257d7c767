"""Access control of a server's zenoh session: all messages not listed here are denied both ways.

zenoh passes a message if one of the listed key expressions includes the key expression of the
message. A list of allowed keys therefore also blocks wider keys (`**`, `solidcloud/*/scene/**`); a
list of denied keys would not.
"""

from typing import Any

from ...schemas.wire.key_expressions import ROOT

# Queries of every operation pass. The server answers those of an unknown operation with an error.
_QUESTIONS = [f"{ROOT}/scenes", f"{ROOT}/scene/*/*/*"]
_STATES = [f"{ROOT}/state/*/*/*"]
_RESIDENCY = [f"{ROOT}/residency/*/*"]
_WISHES = [f"{ROOT}/wish/*/*/*"]
_CLIENTS = [f"{ROOT}/client/*/*"]
_SERVERS = [f"{ROOT}/alive/**"]

# Messages from clients, and their allowed key expressions. No client may declare a queryable or a
# subscriber, send replies or publish states: a client receives data only from the server, as
# replies to its own queries.
_FROM_CLIENTS = {
    "query": [*_QUESTIONS, *_STATES, *_RESIDENCY],
    "put": _WISHES,
    "delete": _WISHES,
    "liveliness_token": _CLIENTS,
    "liveliness_query": _SERVERS,
    "declare_liveliness_subscriber": _SERVERS,
}
# Messages from the server. The last two make clients send their tokens.
_TO_CLIENTS = {
    "reply": [*_QUESTIONS, *_STATES, *_RESIDENCY],
    "declare_queryable": [*_QUESTIONS, *_STATES, *_RESIDENCY],
    "declare_subscriber": _WISHES,
    "liveliness_token": _SERVERS,
    "liveliness_query": _CLIENTS,
    "declare_liveliness_subscriber": _CLIENTS,
}


def access_control() -> dict[str, Any]:
    """Return zenoh's configuration `access_control` of a server."""
    rules = [
        {
            "id": f"{flow}-{message}",
            "messages": [message],
            "flows": [flow],
            "permission": "allow",
            "key_exprs": allowed,
        }
        for flow, messages in (("ingress", _FROM_CLIENTS), ("egress", _TO_CLIENTS))
        for message, allowed in messages.items()
    ]
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": "everybody"}],
        "policies": [{"rules": [rule["id"] for rule in rules], "subjects": ["everybody"]}],
    }


def stream_priorities() -> list[dict[str, Any]]:
    """Return zenoh's configuration `qos/network` of a server: the transport of states and changes.

    It overrides the client's choice. A reply has the settings of its query, so the query is changed
    on arrival. A state is dropped if its client does not accept it: under zenoh's default, or a
    client's choice, it would wait 200 ms and delay the states of all users. The priority differs
    from that of other replies, because a droppable message would wait behind a reply that blocks
    (zenoh's issue 2584). Express: the states of a frame are not held back to fill a batch. The same
    applies to changes of what is resident, which come after states.
    """
    return [
        {
            "id": name,
            "messages": ["query"],
            "flows": ["ingress"],
            "key_exprs": keys,
            "overwrite": {"congestion_control": "drop", "priority": priority, "express": True},
        }
        for name, keys, priority in (
            ("states", _STATES, "interactive_high"),
            ("residency", _RESIDENCY, "interactive_low"),
        )
    ]
