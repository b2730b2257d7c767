"""Code shared by both sides of zenoh: endpoints, session settings, key files and sealed replies.

May import server/scene_interface.py, schemas.
Begin with zenoh_settings.py.
"""
