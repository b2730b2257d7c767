"""Parts of scripts/chaos: faults, clients, rogue clients, the check of answers and the report."""
