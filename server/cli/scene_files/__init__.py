"""`solidcloud scene new` and `scene check`.

May import server.archives, server.residency, server/scene.py, server/scene_archives.py,
server/scene_interface.py, builder, schemas.
Begin with scene_new.py.
"""
