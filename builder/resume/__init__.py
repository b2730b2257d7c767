"""State on disk by which an interrupted build continues: journal, build directory, lock.

May import builder/config.py, builder.run, builder.sources, builder.sources.common, schemas.
Begin with build_directory.py.
"""
