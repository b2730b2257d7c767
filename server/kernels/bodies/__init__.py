"""Users and objects against one another.

May import server.kernels.core, server.kernels.motion, schemas.
Begin with body_pairs.py.
"""
