"""The clash check: clearance of an avatar along a path, the clashes on it, and files of them.

It works with a `Client` and with a `Scene`, without the viewer.

May import server/scene_interface.py, schemas.
Begin with clash_check.py.
"""
