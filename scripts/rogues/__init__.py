"""Rogue clients: whoever reaches a server's port and lies, listens or takes another's place."""
