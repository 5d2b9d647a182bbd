"""Floor 1: where points and cameras are."""
