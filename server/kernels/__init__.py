"""Compiled functions of the server."""
