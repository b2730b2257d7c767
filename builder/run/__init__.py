"""Execution of work units: processes, a dask cluster, progress.

May import builder/build_limits.py, schemas.
Begin with executor.py.
"""
