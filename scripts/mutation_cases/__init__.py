"""What scripts/mutation is made of."""
