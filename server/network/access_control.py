"""What a server lets pass over its zenoh session: everything that is not listed here is denied, in both directions.

zenoh decides by inclusion: a message passes if one of the listed key expressions includes the message's own. So a list
of what is allowed also stops wider keys (`**`, `solidcloud/*/scene/**`), and a list of what is denied does not.
"""

from typing import Any

from ...schemas.wire.keys import ROOT

# An operation that this server does not have is answered with an error, so any is let pass.
_QUESTIONS = [f"{ROOT}/scenes", f"{ROOT}/scene/*/*/*"]
_STATES = [f"{ROOT}/state/*/*/*"]
_WISHES = [f"{ROOT}/wish/*/*/*"]
_CLIENTS = [f"{ROOT}/client/*/*"]
_SERVERS = [f"{ROOT}/alive/**"]

# Messages and the key expressions they may come under. Nobody may declare a queryable or a subscriber, reply or publish
# states: what a client hears comes from the server, as replies to its own questions.
_FROM_CLIENTS = {
    "query": [*_QUESTIONS, *_STATES],
    "put": _WISHES,
    "delete": _WISHES,
    "liveliness_token": _CLIENTS,
    "liveliness_query": _SERVERS,
    "declare_liveliness_subscriber": _SERVERS,
}
# The server's own; the last two have clients send it their tokens.
_TO_CLIENTS = {
    "reply": [*_QUESTIONS, *_STATES],
    "declare_queryable": [*_QUESTIONS, *_STATES],
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


def state_priority() -> list[dict[str, Any]]:
    """Return zenoh's configuration `qos/network` of a server: how states travel, whatever their asker says.

    A reply travels as its query did, so the query is changed when it comes. A state is dropped where its client takes
    none: under zenoh's default, or a client's choice, it would wait 200 ms and hold up the states of all users.
    The priority is not that of other replies, because what is dropped where there is no room would wait behind a reply
    that blocks (zenoh's issue 2584). Express: a frame's states are not kept back to fill a batch.
    """
    overwrite = {"congestion_control": "drop", "priority": "interactive_high", "express": True}
    return [
        {
            "id": "states",
            "messages": ["query"],
            "flows": ["ingress"],
            "key_exprs": _STATES,
            "overwrite": overwrite,
        }
    ]
