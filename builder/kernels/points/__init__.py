"""Kernels over points: quantisation, Morton order, hashing, voxel records.

May import schemas.
Begin with spool_rows.py.
"""
