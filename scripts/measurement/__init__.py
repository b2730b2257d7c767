"""Code that several benchmark scripts share: machine, archives, poses, definition, results."""
