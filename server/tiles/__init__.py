"""Tiles for viewers: a sample of a scene, its voxels near a place, and the content of one.

Records are read from the archives' files, and nothing is added to the voxels in memory: a viewer
that looks far away does not displace what users touch.

May import server.archives, server.residency, builder.voxel, schemas.
Begin with voxel_tile.py.
"""
