"""Runnable studies and the main job: `python -m experiments.NAME`."""
