"""Offline builder: turns scans into one archive."""
