"""The page's side of the viewer: its files and their web server, its messages, and its frame.

May import schemas.
Begin with page_messages.py.
"""
