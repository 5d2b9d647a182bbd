"""Quantities learned for each frame: exposure and camera."""
