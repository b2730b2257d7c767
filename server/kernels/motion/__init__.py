"""Screw motions and the time of first contact along them.

May import server.kernels.core, server.kernels.overlap, schemas.
Begin with screw_motion.py.
"""
