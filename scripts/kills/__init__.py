"""Shared code of kill_builds and tests/end_to_end/test_kills.py: a small build, and ways to stop it."""
