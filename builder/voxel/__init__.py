"""Construction of a voxel's record: octree, sphere hierarchies, radii, dense voxels.

May import builder/build_limits.py, builder/config.py, builder.kernels, builder.spool, schemas.
Begin with voxel_octree.py.
"""
