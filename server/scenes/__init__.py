"""Scenes of several placed archives, and the scene file that opens any scene.

May import server.archives, server.avatars, server.kernels, server.observability, server.queries,
server.queries.context, server.residency, server.runtime, server/scene.py, server.served,
server.simulation, server.simulation.effects, schemas.
Begin with open_scene.py.
"""
