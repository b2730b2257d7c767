"""Commands of `solidcloud`, one file each; a command imports its dependencies when it runs.

Those about archives are in archives/.

May import server.avatars, server.cli.doctor, server.cli.input, server.cli.output,
server.cli.scene_files, server.cli.warming, server/client.py, server.report.accuracy,
server.report.accuracy.measurement, server.report.accuracy.page, server.report.common,
server.report.load, server.report.load.runs, server.report.walk, server/scene.py,
server/scene_interface.py, server.simulation, server.viewer, server.zenoh_client,
server.zenoh_common, server.zenoh_server, builder, schemas.
Begin with serve_command.py.
"""
