"""Helpers around the operating system: interrupts, OS errors, durable new files, encodings of text.

May import schemas/errors.py.
Begin with new_file.py.
"""
