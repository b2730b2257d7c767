"""Simulated users: where they walk, the clock of their frames, their processes, the outcome of every frame.

May import server.avatars, server.cli.input, server/client.py, server.report.common,
server.residency, builder, schemas.
Begin with user_traces.py or user_process.py.
"""
