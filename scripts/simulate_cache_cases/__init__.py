"""Parts of scripts/simulate_cache: requests of a trace, replay with a policy, Belady's optimum."""
