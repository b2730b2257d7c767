"""`scripts/test --quick`: the tests of what changed, within a time limit."""
