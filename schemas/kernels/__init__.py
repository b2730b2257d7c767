"""Compiled functions that both sides need."""
