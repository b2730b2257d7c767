"""Archive files: index, shards, voxel records and their codec, as FORMAT.md specifies.

May import schemas/errors.py, schemas.kernels, schemas.runtime.
Begin with archive.py, which opens an archive; index.py declares the datasets of its index, voxel.py
the data of one voxel.
"""
