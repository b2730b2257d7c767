"""Compiled plain descents, with which the accuracy report compares the server's engine.

May import server.kernels, builder, schemas.
Begin with plain_descent.py.
"""
