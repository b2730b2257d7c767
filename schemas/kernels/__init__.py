"""Compiled functions that both builder and server need."""
