"""The measurements of `solidcloud accuracy`: test data, settings, reference answers, times and errors.

May import server.avatars, server.report.common, server.residency, server/scene.py, builder, schemas.
Begin with engine_settings.py.
"""
