"""Code that effects share: the scene as they query it, other bodies, and the frame of one user.

May import server.archives, server.avatars, server.kernels, server.queries, server.runtime,
server/scene_interface.py, schemas.
Begin with frame.py and collision_world.py.
"""
