"""All pairs in contact, the deepest of them, and clusters of touched cells.

May import server.kernels.core, schemas.
Begin with contact_pairs.py.
"""
