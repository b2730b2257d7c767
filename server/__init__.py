"""Online: poses and requests in, verdicts out."""
