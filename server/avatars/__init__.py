"""Avatars: their model, their files and meshes, and the registry of each client's avatars.

May import server.kernels, server/scene_interface.py, builder.sources, builder.sources.common,
schemas.
Begin with avatar_model.py; avatar_shape.py takes what a user has, mesh_points.py a mesh.
"""
