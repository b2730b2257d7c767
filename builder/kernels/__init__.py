"""Compiled functions of the builder."""
