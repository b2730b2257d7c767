"""Bodies of users and objects: against one another, their patches, and how one leaves contact with the scan.

May import server.kernels.core, server.kernels.motion, schemas.
Begin with body_pairs.py.
"""
