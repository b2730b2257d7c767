"""What the sessions of the transport are configured to be. No zenoh session is opened."""

import json

from solidcloud.server.zenoh_common.zenoh_settings import session_config


def test_sessions_find_nobody_and_are_found_by_nobody():
    for config in (session_config(listen="tcp/127.0.0.1:7447"), session_config(connect="tcp/127.0.0.1:7447")):
        settings = json.loads(str(config))
        assert settings["scouting"]["multicast"]["enabled"] is False
        assert settings["scouting"]["gossip"]["enabled"] is False
        assert settings["transport"]["shared_memory"]["enabled"] is False
        assert settings["transport"]["link"]["rx"]["max_message_size"] == 32 << 20
        assert settings["adminspace"]["enabled"] is False
    # A client's session listens nowhere.
    assert settings["listen"]["endpoints"] == []
