"""Shared code of the benchmark scripts and check_exact; each section of bench_engine is one file."""
