"""Ways to stop a small build, for scripts/kill_builds, scripts/interrupt_readers and their tests."""
