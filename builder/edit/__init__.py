"""Changes of a finished archive: scans added or removed, and the transaction that publishes them.

May import builder/build_limits.py, builder/config.py, builder.kernels, builder.passes,
builder.resume, builder.run, builder.sources, builder.sources.common, builder.spool, builder.voxel,
schemas.
Begin with edit_archive.py.
"""
