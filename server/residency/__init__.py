"""Voxels in memory: cache, arena and allocator, eviction, prefetch, coarse bounds.

May import server.kernels, server.runtime, schemas.
Begin with voxel_cache.py.
"""
