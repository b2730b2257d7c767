"""Counters of a scene, and their export as Prometheus metrics.

May import schemas.
Begin with request_stats.py.
"""
