"""Data that all kernels read: voxel layout, placed avatars, voxels in reach, stop flag.

May import schemas.
Begin with scene_arrays.py.
"""
