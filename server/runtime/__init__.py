"""Process-level helpers: stop flags and deadlines, threads, heap.

May import schemas.
Begin with stop_flag.py.
"""
