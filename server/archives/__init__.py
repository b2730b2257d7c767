"""Opened archive generations, their placement in the world, scene information, merged answers.

May import server.avatars, server.observability, server.queries, server.queries.context,
server.residency, server.runtime, builder.voxel, schemas.
Begin with archive_generation.py.
"""
