"""The command `solidcloud`.

May import server.cli.commands, builder, schemas.
Begin with main.py; commands/ contains one file per command.
"""
