"""A radiance field and its losses composed to a model, and presets."""
