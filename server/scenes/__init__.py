"""Parts of a scene: its queries, and the archives and avatars that a scene file names.

May import server.archives, server.avatars, server.kernels, server.observability, server.queries,
server.queries.context, server.residency, server.runtime, server/scene_interface.py,
server.simulation.effects, schemas.
Begin with scene_questions.py.
"""
