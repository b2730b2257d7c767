"""What a scene looks like, for viewers: its voxels near a place, and the points or spheres of one.

Records are read from the archives' files, and nothing is added to the voxels in memory: a viewer
that looks far away does not displace what users touch.

May import server.archives, schemas.
Begin with voxel_tile.py.
"""
