"""The shared core: what the bytes of an archive and of a message mean."""
