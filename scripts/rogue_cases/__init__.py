"""Attacks of rogue clients, for scripts/attack_wire, scripts/chaos and the tests: sessions that reach a
server's port and forge, eavesdrop or impersonate."""
