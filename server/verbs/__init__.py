"""The verbs of the command `solidcloud`, a file a subject. Each imports what it needs inside itself."""
