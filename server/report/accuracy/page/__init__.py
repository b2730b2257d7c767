"""The page of `solidcloud accuracy`: charts, texts and HTML, made from the results.

May import server.report.accuracy.measurement, server.report.common, builder, schemas.
Begin with accuracy_page.py.
"""
