"""Numba kernels of the server, a folder a subject.

May import schemas.
Begin with core/voxel_layout.py, then collide/collide_poses.py.
"""
