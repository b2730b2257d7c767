"""Generated scenes, scans and avatars with known ground truth, for tests, reports and the demo.

May import schemas.
Begin with scenes.py.
"""
