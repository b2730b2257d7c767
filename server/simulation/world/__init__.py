"""The scene as effects query it, and the state of one user in one frame.

May import server.archives, server.avatars, server.kernels, server.queries, server.queries.context,
server.runtime, server/scene_interface.py, schemas.
Begin with frame.py and collision_world.py.
"""
