"""Offline builder: makes an archive from laser scans.

Begin with pipeline.py, which runs the passes in order; config.py holds the options of a build.
"""
