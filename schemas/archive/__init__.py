"""Archive files: index, shards, voxel records and their codec, as FORMAT.md specifies.

May import schemas/errors.py, schemas.kernels, schemas.process.
Begin with archive.py, which opens an archive; voxel.py describes the data of one voxel.
"""
