"""Contact or not: two hierarchies descended together.

May import server.kernels.core, schemas.
Begin with collide_poses.py.
"""
