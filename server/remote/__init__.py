"""Client side of the wire: batches of requests, sessions, states, avatars added.

May import server.network, server.served, schemas.
Begin with request_batches.py; ../client.py uses all of it.
"""
