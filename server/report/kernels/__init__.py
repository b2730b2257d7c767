"""Plain descents that the accuracy report compares with.

May import server.kernels, builder, schemas.
Begin with plain_descent.py.
"""
