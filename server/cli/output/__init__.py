"""Text on the terminal: tables, progress, answers, the display of `top`.

May import server.residency, builder, schemas.
Begin with console.py.
"""
