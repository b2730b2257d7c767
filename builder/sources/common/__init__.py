"""Interface of a scan, and text parsing shared by the readers.

May import schemas.
Begin with scan.py: a scan yields blocks of points.
"""
