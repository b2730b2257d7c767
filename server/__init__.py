"""Collision server: exact queries against an archive, in process or over zenoh.

Begin with scene.py (in process) or client.py (over zenoh); they offer the same methods.
"""
