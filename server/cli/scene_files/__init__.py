"""`solidcloud scene new` and `scene check`.

May import server.archives, server.residency, server/scene.py, server/open_scene_file.py,
server/scene_interface.py, builder, schemas.
Begin with scene_new.py.
"""
