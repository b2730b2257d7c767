"""`solidcloud accuracy`: what an error allowed saves in time, and which errors settings have.

May import server/scene.py, server.report.accuracy.measurement, server.report.accuracy.page,
server.report.common, builder, schemas.
Begin with accuracy_report.py; measurement/ measures, page/ draws and describes the results.
"""
