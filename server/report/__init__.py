"""What the walkthrough and the accuracy report write."""
