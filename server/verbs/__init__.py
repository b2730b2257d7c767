"""Verbs of the command `solidcloud`, one file per subject.

Each function imports its dependencies inside itself, which keeps `--help` fast.
"""
