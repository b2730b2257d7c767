"""Protocols between a service and the scene that it serves, and limits on avatars.

May import server.runtime, schemas.
Begin with served_scene.py; asks.py has the query methods of `Scene` and `Client`.
"""
