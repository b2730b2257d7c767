"""Child processes of a server's start: some compile too, one tries kernels that may be wrong.

May import server/scene.py, builder, schemas.
Begin with parallel_warming.py.
"""
