"""Parts of scripts/simulate_cache: the requests of a trace, their replay with a policy, and Belady's optimum."""
