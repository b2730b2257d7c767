"""Reports: `solidcloud accuracy` and the demo.

May import builder, schemas.
Begin with accuracy/accuracy.py or walk/demo_walk.py.
"""
