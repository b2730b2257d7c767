"""Passes of a build, one file a pass: survey, spool, filter, shards, radius, preview, verification.

May import builder/build_limits.py, builder/config.py, builder.kernels, builder.resume, builder.run,
builder.sources, builder.sources.common, builder.spool, builder.voxel, schemas.
Read in the order in which pipeline.py calls them: survey_pass.py, spool_pass.py, filter_pass.py,
cell_size.py, build_shards.py, point_spacing.py, preview.py, verify.py.
"""
