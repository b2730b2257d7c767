"""`solidcloud accuracy`: query time and errors of each setting.

May import server.report.accuracy.measurement, server.report.accuracy.page, server.report.common,
builder, schemas.
Begin with accuracy_report.py; measurement/ fills in the results, page/ draws and describes them.
"""
