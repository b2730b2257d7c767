"""Query engines, one file a query, each a pure function over one archive.

May import server.avatars, server.kernels, server.residency, server.runtime, schemas.
Begin with resolve.py, then collide.py.
"""
