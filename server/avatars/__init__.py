"""Avatars: the model of one, and the registry of the avatars of each client.

May import server.kernels, server.served, builder.voxel, schemas.
Begin with avatar_model.py.
"""
