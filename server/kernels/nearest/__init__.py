"""Nearest pairs: distance, distance by scan, search in order of distance.

May import server.kernels.core, schemas.
Begin with nearest_search.py.
"""
