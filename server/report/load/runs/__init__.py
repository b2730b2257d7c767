"""Runs of a load test: server process, users, budgets, check of the verdicts, figures and targets.

May import server/client.py, server.report.common, server.report.load.users, server/scene.py,
builder, schemas.
Begin with load_run.py.
"""
