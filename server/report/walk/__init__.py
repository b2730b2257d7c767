"""The demo: a walk through a scan over zenoh, and the walkthrough of [Fig12].

May import server.cli.input, server.cli.output, server/client.py, server.report.common,
server/scene.py, builder, schemas.
Begin with demo_walk.py.
"""
