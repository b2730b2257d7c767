"""Rays and points against the scene: raycast, nearest point, normals.

May import server.kernels.core, schemas.
Begin with hits.py; surface.py has the points around one point.
"""
