"""Spool of all points of a build: sorted runs on disk, and the pass that writes them.

May import builder/config.py, builder.kernels, builder.resume, builder.sources.common, schemas.
Begin with spool.py.
"""
