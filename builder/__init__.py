"""Offline builder: laser scans in, an archive out.

Begin with pipeline.py, which runs the passes in order; config.py holds the options of a build.
"""
