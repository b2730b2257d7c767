"""Provide what every room runs on: compiled kernels and their files, interrupts, OS errors, new files, text.

May import schemas/errors.py.
Begin with compiling.py, the door to numba, and new_file.py, the way in which files are written.
"""
