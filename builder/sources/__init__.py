"""One reader a scan format."""
