"""Helpers of scripts/mutation."""
