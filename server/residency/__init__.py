"""Voxels in memory: cache, arena and allocator, eviction, prefetch and level of detail.

May import server.kernels, server.runtime, schemas.
Begin with voxel_cache.py.
"""
