"""Server side of zenoh: transport, fair queues, sessions, dispatch, start and stop.

May import server.zenoh_common, server.observability, server.runtime, server/scene_interface.py,
schemas.
Begin with serve_loop.py; transport.py carries the bytes, request_dispatcher.py interprets them.
"""
