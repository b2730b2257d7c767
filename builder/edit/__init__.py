"""Changes of a finished archive: scans added or removed, and the transaction that publishes them.

May import builder/config.py, builder.kernels, builder.passes, builder/pipeline.py, builder.resume,
builder.run, builder.sources, builder.sources.common, builder.spool, builder.voxel, schemas.
Begin with edit_archive.py.
"""
