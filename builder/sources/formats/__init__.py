"""Readers of scan formats, one file a format; ../format_table.py lists them.

May import builder.kernels, builder.sources.common, schemas.
Begin with text.py, the simplest reader; las.py and e57.py read the usual formats.
"""
