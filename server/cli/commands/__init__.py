"""Commands of `solidcloud`, one file each; a command imports its dependencies when it runs.

May import server.archives, server.avatars, server.cli.input, server.cli.output,
server.cli.scene_files, server/client.py, server.zenoh_common, server.report.accuracy,
server.residency, server/scene.py, server.zenoh_server, server.simulation, builder, schemas.
Begin with serve_command.py or build_command.py.
"""
