"""Load test of a server: `solidcloud loadtest`.

May import server.avatars, server.report.common, server.report.load.page, server.report.load.runs,
server.report.load.users, builder, schemas.
Begin with load_test.py.
"""
