"""Offline: scans in, one archive out."""
