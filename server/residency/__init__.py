"""Voxels in memory: cache, arena and allocator, eviction, prefetch and coarse bounds.

May import server.kernels, server.runtime, schemas.
Begin with voxel_cache.py.
"""
