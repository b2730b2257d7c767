"""State on disk by which an interrupted build continues: kept work, lock, transaction.

May import builder/build_limits.py, builder/config.py, builder.run, builder.sources,
builder.sources.common, builder.spool, schemas.
Begin with kept_work.py, which decides what a restart keeps.
"""
