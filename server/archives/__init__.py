"""Placed archives of a scene: open generations, hot reload, questions to several, merged answers.

May import server.avatars, server.observability, server.queries, server.queries.context,
server.residency, server.runtime, builder.voxel, schemas.
Begin with placed_archive.py.
"""
