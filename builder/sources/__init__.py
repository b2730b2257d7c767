"""Scan inputs: the files of a folder or a scan list, opened as scans with a placement.

May import builder.run, builder.sources.common, builder.sources.formats, schemas.
Begin with format_table.py, the table of formats; scan_files.py opens a file of any format.
"""
