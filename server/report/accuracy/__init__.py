"""`solidcloud accuracy`: query time and errors of each setting.

May import server.avatars, server.kernels, server.report.common, server.report.kernels,
server.residency, server/scene.py, builder, schemas.
Begin with accuracy.py.
"""
