"""What scripts/chaos does to a server, and who judges its answers."""
