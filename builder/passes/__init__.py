"""Passes of a build: survey, filter, radius classes, shards, preview, verification.

May import builder/config.py, builder.kernels, builder.resume, builder.run, builder.sources,
builder.sources.common, builder.spool, builder.voxel, schemas.
Read in the order in which pipeline.py calls them: survey.py, filter.py, build_shards.py, verify.py.
"""
