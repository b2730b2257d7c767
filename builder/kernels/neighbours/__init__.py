"""Kernels over neighbouring points: spacing, radius classes, normals, filters.

May import builder.kernels.points, builder.kernels.trees, schemas.
Begin with nearest_neighbours.py.
"""
