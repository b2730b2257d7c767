"""Helpers around the operating system: interrupts, error messages of the OS, durable new files.

May import schemas/errors.py.
Begin with new_file.py.
"""
