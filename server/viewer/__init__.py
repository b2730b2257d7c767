"""The viewer: a process that is a zenoh client, and a page that it serves to browsers.

The page draws; the server of the scene moves the users. DESIGN.md has the messages between the
process and the page. The library websockets has its only door in page/web_server.py.

May import server.clash, server/client.py, server/scene_interface.py, server.runtime,
server.viewer.feeds, server.viewer.page, server.viewer.panels, server.viewer.users, schemas.
Begin with viewer.py.
"""
