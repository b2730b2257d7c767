"""Messages between client and server: requests, answers, keys and encodings, as WIRE.md specifies.

May import schemas.archive, schemas/errors.py.
Begin with messages.py; requests.py and answers.py declare the types of the queries.
"""
