"""Scene files: archives, avatars, objects and effects of one scene, as SCENE.md specifies.

May import schemas.archive, schemas/errors.py, schemas.runtime, schemas.wire.
Begin with scene_file.py; effect_table.py declares the effects.
"""
