"""Shared definitions of the archive format, the wire protocol and the scene file."""
