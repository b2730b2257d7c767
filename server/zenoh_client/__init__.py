"""Client side of zenoh: connection to a server, the client's id and avatars, sessions.

May import server.runtime, server.zenoh_common, server/scene_interface.py, schemas.
Begin with ../client.py, which uses all of it.
"""
