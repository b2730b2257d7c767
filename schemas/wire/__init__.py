"""Messages between client and server: requests, answers, keys and encodings, as WIRE.md specifies.

May import schemas.archive, schemas/errors.py.
Begin with question_table.py, which declares each query; requests.py and answers.py have the types.
"""
