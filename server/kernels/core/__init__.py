"""What all kernels read: voxel layout, placed avatars, voxels in reach, stop flag.

May import schemas.
Begin with voxel_layout.py.
"""
