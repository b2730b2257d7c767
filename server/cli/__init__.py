"""The command `solidcloud`.

May import server.cli.commands, server.cli.commands.archives, server.cli.output, builder, schemas.
Begin with main.py; commands/ contains one file per command.
"""
