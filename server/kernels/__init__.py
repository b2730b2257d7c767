"""Numba kernels of the server, a folder a subject.

May import schemas.
Begin with core/scene_arrays.py, then collide/collide_poses.py.
"""
