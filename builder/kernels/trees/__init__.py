"""Kernels of bounding sphere hierarchies.

May import schemas.
Begin with build_tree.py; bounding_sphere.py bounds one set of points.
"""
