"""What the query engines share: scene data, budgets, costs, proofs of clearance.

May import server.avatars, server.kernels, server.residency, server.runtime, schemas.
Begin with query_context.py.
"""
