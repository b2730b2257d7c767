"""The settings of a zenoh session, server's or client's."""

import json
from typing import Any

import zenoh

from ...schemas.wire.encoding import MAX_MESSAGE_BYTES
from .access_control import access_control, state_priority

# How wishes travel; states travel the same way (access.state_priority).
FRAME_QOS: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.DROP,
    "priority": zenoh.Priority.INTERACTIVE_HIGH,
    "express": True,
}


def session_config(*, listen: str | None = None, connect: str | None = None) -> zenoh.Config:
    """The configuration of a session, server's or client's: one endpoint, and nothing found by itself."""
    settings: dict[str, Any] = {
        # A peer opens although nobody is there yet, and goes on trying; a zenoh "client" fails instead.
        "mode": "peer",
        "listen/endpoints": [listen] if listen else [],
        "connect/endpoints": [connect] if connect else [],
        # By default 1 s, growing to 4 s: an outage would last that much longer than the server is away.
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 500, "period_increase_factor": 2},
        # How long opening waits for the connection [ms], also now and then where it is there at once: 500.
        "scouting/delay": 200,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # A killed process would leave 16 MiB behind in /dev/shm.
        "transport/shared_memory/enabled": False,
        # A longer message is dropped unread, and its sender's query expires; by default 1 GiB is taken in.
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        # How long a reply waits for a client that takes none before its link is closed [µs]; by default 5 s.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 200_000,
        # By default 100 connections that never say a word keep new ones out for 10 s.
        "transport/unicast/accept_timeout": 1000,
        "transport/unicast/accept_pending": 1000,
    }
    if listen:
        settings["access_control"] = access_control()
        settings["qos/network"] = state_priority()
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config
