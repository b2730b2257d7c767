"""Changes of a finished archive: adding and removing scans, and the publishing of the result.

May import builder/build_limits.py, builder/config.py, builder.kernels, builder.passes,
builder.resume, builder.run, builder.sources, builder.sources.common, builder.spool, builder.voxel,
schemas.
Begin with edit_archive.py.
"""
