"""Shared code of loadtest and simulate_cache: traces of users in a generated town, and their use."""
