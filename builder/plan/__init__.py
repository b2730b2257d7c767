"""Estimates before a build: memory, disk and time that it needs, and stray points of the scans.

May import builder/build_limits.py, builder/config.py, builder.kernels, builder.passes,
builder/pipeline.py, builder.run, builder.sources, builder.sources.common, builder.spool,
builder.synthetic, builder.voxel, schemas.
Begin with build_plan.py; stray_points.py finds what hangs in the air.
"""
