"""Execution of work units: processes, a dask cluster, memory shares, progress.

May import builder/config.py, schemas.
Begin with executor.py.
"""
