"""Voxels in memory: the cache, its arena, eviction, prefetch and the level of detail.

May import server.kernels, server.runtime, schemas.
Begin with voxel_cache.py.
"""
