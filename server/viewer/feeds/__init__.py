"""Reading from the server for all browsers: the scene, residency, statistics, and tiles.

May import server/client.py, server.runtime, server.viewer.page, server.zenoh_client, schemas.
Begin with scene_link.py.
"""
