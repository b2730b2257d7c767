"""What scripts/kill_builds and tests/end_to_end/test_kills.py share: a small build, and ways to stop it."""
