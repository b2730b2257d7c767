"""Zenoh basics of server and client: endpoints, session settings, keys and replies.

May import server.served, schemas.
Begin with zenoh_settings.py.
"""
