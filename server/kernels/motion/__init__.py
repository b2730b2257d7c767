"""Screw motions and the time of first contact along them.

May import server.kernels.collide, server.kernels.core, schemas.
Begin with screw_motion.py.
"""
