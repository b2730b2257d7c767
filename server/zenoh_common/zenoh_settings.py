"""Settings of a zenoh session, for servers and clients."""

import json
from typing import Any

import zenoh

from ...schemas.wire.request_limits import MAX_MESSAGE_BYTES
from .access_control import access_control, stream_priorities

# Transport of motion commands; states use the same (access_control.stream_priorities).
FRAME_QOS: dict[str, Any] = {
    "congestion_control": zenoh.CongestionControl.DROP,
    "priority": zenoh.Priority.INTERACTIVE_HIGH,
    "express": True,
}


def session_config(*, listen: str | None = None, connect: str | None = None) -> zenoh.Config:
    """Return the configuration of a server's or client's session: one endpoint, no discovery."""
    settings: dict[str, Any] = {
        # A zenoh "peer" opens without a server and keeps trying to connect; a zenoh "client" fails.
        "mode": "peer",
        "listen/endpoints": [listen] if listen else [],
        "connect/endpoints": [connect] if connect else [],
        # The default of 1 s, growing to 4 s, would prolong each outage by this time.
        "connect/retry": {"period_init_ms": 50, "period_max_ms": 250, "period_increase_factor": 2},
        # How long opening waits for the connection [ms]; default 500. Opening sometimes waits this
        # long although the connection exists at once.
        "scouting/delay": 200,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        # With shared memory a killed process would leave 16 MiB in /dev/shm.
        "transport/shared_memory/enabled": False,
        # A longer message is dropped unread, and its sender's query times out; default 1 GiB.
        "transport/link/rx/max_message_size": MAX_MESSAGE_BYTES,
        # How long a reply waits for a client that accepts none before its link is closed [µs];
        # default 5 s.
        "transport/link/tx/queue/congestion_control/block/wait_before_close": 200_000,
        # By default, 100 connections that send nothing block new ones for 10 s.
        "transport/unicast/accept_timeout": 1000,
        "transport/unicast/accept_pending": 1000,
    }
    if listen:
        settings["access_control"] = access_control()
        settings["qos/network"] = stream_priorities()
    config = zenoh.Config()
    for path, value in settings.items():
        config.insert_json5(path, json.dumps(value))
    return config
