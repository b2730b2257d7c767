"""Parts of scripts/bench_build: observed builds, limits of the machine, rates, sizes, picture."""
