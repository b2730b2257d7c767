"""Scan inputs: the files of a folder or a scan list, opened as scans with a placement.

May import builder.run, builder.sources.common, builder.sources.formats, schemas.
Begin with scan_files.py, which opens a file of any format.
"""
