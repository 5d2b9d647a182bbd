"""Floor 5: how good, how long."""
