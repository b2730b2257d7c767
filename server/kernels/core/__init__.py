"""Data that all kernels read, and what several share: voxel layout, placed avatars, reach, descent.

May import schemas.
Begin with scene_arrays.py.
"""
