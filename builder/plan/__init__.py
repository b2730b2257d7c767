"""Estimates of memory, disk and time of a build before it runs.

May import builder/config.py, builder.kernels, builder.synthetic, builder.passes, builder/pipeline.py,
builder.run, builder.sources, builder.sources.common, builder.spool, builder.voxel, schemas.
Begin with build_plan.py.
"""
