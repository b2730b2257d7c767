"""Pictures of a scene for `Scene.plot`.

May import server.archives, server.avatars, builder.voxel, schemas.
Begin with floor_plan.py.
"""
