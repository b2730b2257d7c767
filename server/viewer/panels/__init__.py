"""Content of the page's panels: effects, paths, measurements of a pose, and bounding spheres.

May import server.cli.input, server.viewer.feeds, server.viewer.page, schemas.
Begin with pose_measurement.py.
"""
