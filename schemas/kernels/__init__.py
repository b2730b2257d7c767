"""Numba kernels of the file format, and how all kernels are compiled and cached.

May import nothing of the package.
Begin with compiling.py, the only module that imports numba.
"""
