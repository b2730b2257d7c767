"""Checks of this machine and of the installation, for `solidcloud doctor`.

May import server.cli.output, server/scene.py, builder, schemas.
Begin with check_list.py.
"""
