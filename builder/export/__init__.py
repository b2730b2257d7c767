"""Points of an archive written as LAS, LAZ, PLY or VTKHDF.

May import builder.run, builder.voxel, schemas.
Begin with export_archive.py.
"""
