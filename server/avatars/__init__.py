"""Avatars: their model, and the registry of each client's avatars.

May import server.kernels, server/scene_interface.py, builder.voxel, schemas.
Begin with avatar_model.py.
"""
