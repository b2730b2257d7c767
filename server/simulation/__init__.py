"""Simulation of frames, which turn motion commands into poses, and the replay log.

May import server.archives, server.avatars, server.queries, server.runtime,
server/scene_interface.py, server.simulation.world, schemas.
Begin with simulation.py.
"""
