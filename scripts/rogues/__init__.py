"""Rogue clients: sessions that reach a server's port and forge, eavesdrop or impersonate."""
