"""Vectors, screw motions, and the time of first contact along them.

May import server.kernels.core, schemas.
Begin with screw_motion.py.
"""
