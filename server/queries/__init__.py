"""Query engines, one file a query, each a pure function over one archive.

May import server.avatars, server.kernels, server.residency, server.runtime, schemas.
Begin with load_and_search.py, then collide.py.
"""
