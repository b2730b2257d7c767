"""JSON Schemas of the wire's messages, generated from their types by scripts/make_schemas.

May import nothing of the package.
"""
