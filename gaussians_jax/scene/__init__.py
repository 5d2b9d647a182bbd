"""Gaussians, motion and losses composed to a model, and presets."""
