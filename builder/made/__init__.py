"""Scenes that are made, with known truth."""
