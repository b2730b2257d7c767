"""What scripts/bench_walk, scripts/bench_engine and scripts/check_exact share; a section of bench_engine a file."""
