"""Spool of all points of a build: sorted runs on disk.

May import builder/config.py, builder.kernels, schemas.
Begin with spool.py.
"""
