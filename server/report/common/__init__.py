"""Test cases and pictures that several reports share.

May import server.avatars, server.cli.input, server.cli.output, server.residency, server/scene.py,
builder, schemas.
Begin with paper_case.py.
"""
