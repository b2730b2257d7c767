"""`solidcloud accuracy`: query time and errors of each setting.

May import server.avatars, server.report.common, server.residency, server/scene.py, builder, schemas.
Begin with accuracy_report.py.
"""
