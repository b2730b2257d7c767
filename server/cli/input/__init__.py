"""Files and options that a user gives on the command line: poses, points, query inputs.

May import server/scene_interface.py, builder, schemas.
Begin with query_input.py.
"""
