"""The measurements of `solidcloud accuracy`: test data, reference answers, and a module for each of its questions.

May import server.avatars, server.report.common, server/scene.py, builder, schemas.
Begin with accuracy_results.py.
"""
