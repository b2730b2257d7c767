"""Estimates of memory, disk and time of a build before it runs.

May import builder/build_limits.py, builder/config.py, builder.kernels, builder.passes,
builder/pipeline.py, builder.run, builder.sources, builder.sources.common, builder.spool,
builder.synthetic, builder.voxel, schemas.
Begin with build_plan.py.
"""
