"""What scripts/loadtest and its kin share: traces of users in a made town, and what is done with them."""
