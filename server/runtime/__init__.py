"""Process-level helpers: stop flags, deadlines, threads, watchdog, heap.

May import schemas.
Begin with stop_flag.py.
"""
