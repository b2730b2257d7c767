"""Counters of a scene, and their Prometheus text.

May import schemas.
Begin with metrics.py.
"""
