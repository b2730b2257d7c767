"""Code shared by the query engines: scene data, budgets, costs.

May import server.avatars, server.kernels, server.residency, server.runtime, schemas.
Begin with query_context.py.
"""
