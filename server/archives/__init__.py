"""Placed archives of a scene: generations, hot reload, queries over several archives, merging.

May import server.avatars, server.kernels, server.observability, server.queries, server.residency,
server.runtime, schemas.
Begin with placed_archive.py.
"""
