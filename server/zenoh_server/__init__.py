"""The server's end of zenoh: transport, fair queues, sessions, dispatch, start and stop.

May import server.zenoh_common, server.observability, server.runtime, server/scene_interface.py,
schemas.
Begin with service.py; transport.py carries its bytes.
"""
