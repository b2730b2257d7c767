"""Kernels over neighbouring points: spacing, radius classes, filters.

May import builder.kernels.points, schemas.
Begin with nearest_neighbours.py.
"""
