"""Radiance-field models that combine a field, effects and losses, and presets."""
