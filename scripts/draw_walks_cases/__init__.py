"""Cases of scripts/draw_walks: made scans, sessions in them, and their pictures.

Begin with scenarios.py and mover_options.py, which say what is simulated and what must come of it.
"""
