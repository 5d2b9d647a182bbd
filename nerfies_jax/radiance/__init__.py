"""Floor 6: a static radiance field."""
