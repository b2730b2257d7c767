"""Contracts between builder, server and clients: archive format, wire messages, scene files.

Read FORMAT.md, WIRE.md, SCENE.md and NUMERICS.md beside this file; errors.py holds the exceptions.
"""
