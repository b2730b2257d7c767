"""Cases of scripts/walk_scans: routes through real scans, the person, the walks and their figures."""
