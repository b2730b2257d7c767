"""The viewer: a process that is a zenoh client, and a page that it serves to browsers.

The page draws; the server of the scene moves the users. DESIGN.md has the messages between the
process and the page. The library websockets has its only door in web_server.py.

May import server.avatars, server.clash, server.cli.input, server.cli.scene_files,
server/client.py, server.zenoh_client, builder.synthetic, schemas.
Begin with viewer.py.
"""
