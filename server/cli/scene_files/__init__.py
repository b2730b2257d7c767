"""`solidcloud scene new` and `scene check`.

May import server.archives, server.residency, server/scene.py, server/scene_interface.py,
server.scenes, builder, schemas.
Begin with scene_new.py.
"""
