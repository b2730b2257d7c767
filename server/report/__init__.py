"""Reports: `solidcloud accuracy`, `solidcloud loadtest` and the demo.

May import builder, schemas.
Begin with accuracy/accuracy_report.py or walk/demo_walk.py.
"""
