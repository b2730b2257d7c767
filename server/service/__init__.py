"""Server process: zenoh transport, fair queues, sessions, dispatch, start and stop.

May import server.network, server.observability, server.runtime, server.served, schemas.
Begin with service.py; transport.py carries its bytes.
"""
