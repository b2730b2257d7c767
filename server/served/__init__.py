"""Protocol between a service and the scene that it serves, with limits on avatars.

May import server.runtime, schemas.
Begin with served_scene.py.
"""
