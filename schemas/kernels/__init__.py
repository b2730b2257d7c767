"""Numba kernels of the file format.

May import schemas.runtime.
Begin with record_rows.py.
"""
