"""Code that several benchmark scripts and check_exact share: machine, archives, poses, definition, results."""
