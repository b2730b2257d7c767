"""Avatars: their model, their files, and the registry of each client's avatars.

May import server.kernels, server/scene_interface.py, builder.sources,
builder.voxel, schemas.
Begin with avatar_model.py.
"""
