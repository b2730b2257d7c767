"""Attacks of rogue clients, for scripts/attack_wire, scripts/chaos and the tests.

A rogue session reaches a server's port and forges, eavesdrops or impersonates.
"""
