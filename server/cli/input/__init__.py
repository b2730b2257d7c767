"""Files and options that a user gives on the command line: poses, points, query inputs.

May import builder, schemas.
Begin with query_input.py.
"""
