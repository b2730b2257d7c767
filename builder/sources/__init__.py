"""Readers of scan formats, one file per format, all behind open_scans().

Each reader returns Scan objects; a Scan yields its points in blocks.
"""
