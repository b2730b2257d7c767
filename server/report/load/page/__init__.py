"""Page of a load test: pictures, and one HTML file that is written again after every run.

May import server.report.common, server.report.load.runs, server.report.load.users, builder, schemas.
Begin with load_page.py.
"""
