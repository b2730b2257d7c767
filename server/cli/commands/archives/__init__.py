"""Commands of `solidcloud` that make, change, describe and check archives, one file each.

May import server.archives, server.cli.commands, server.cli.input, server.cli.output,
server/client.py, server.residency, builder, schemas.
Begin with build_command.py.
"""
