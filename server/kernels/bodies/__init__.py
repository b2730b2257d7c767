"""Bodies of users and objects: contacts with one another, patches, and ways out of the scan.

May import server.kernels.core, server.kernels.motion, schemas.
Begin with body_pairs.py.
"""
