"""Users of the viewer: their avatar, the place where they begin, and their motion.

May import server.cli.scene_files, server/scene_interface.py, server.runtime, server.viewer.feeds,
server.viewer.page, server.zenoh_client, builder.synthetic, schemas.
Begin with browser_user.py.
"""
