"""Sections of scripts/bench_engine, one file each, and what they share."""
