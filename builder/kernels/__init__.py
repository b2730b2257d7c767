"""Numba kernels of the builder, a folder a subject: points, trees, neighbours.

May import schemas.
Begin with the folder of the subject.
"""
