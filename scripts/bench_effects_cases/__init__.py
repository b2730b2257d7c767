"""Parts of scripts/bench_effects: the cost of each effect, the sections and the picture."""
